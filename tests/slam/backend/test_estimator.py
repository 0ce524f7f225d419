"""The back end: what is read of the map is what the estimate works with, and planes are linearised where they are."""

import re
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from factors import pose_prior, relative_pose_factor
from slam.backend import estimator
from slam.backend.elimination import _ALL_EVERY
from slam.backend.estimator import Backend, BackendError, pose_symbol
from slam.backend.joint_covariance import carried
from slam.config import SlamConfig
from slam.geometry.frames import planar_transform
from slam.registration.relocalization import displacement
from spplanes.spmodel import transform_from_rpy
from tests.factors.factor_scenes import graph_of, values_of
from tests.slam.short_drives import mapped_beginning


def test_covariances_read_are_those_of_the_estimate_whoever_asked_before() -> None:
    run, _ = mapped_beginning("irregular/lidar16", 7, 6)
    slam = run.slam
    landmarks = [one for one in slam.landmarks if one.n_keyframes > 1][:12]
    keys = sorted({key for one in landmarks for key in (one.key, one.anchor_key)} | {pose_symbol(5)})
    assert len(landmarks) > 5
    used, wanted = slam.backend.joint_covariance(keys), keys[:3]
    after = slam.backend.read_joint_covariance(wanted).full
    slam.backend.restore(slam.backend.snapshot())  # nothing is remembered
    before = slam.backend.read_joint_covariance(wanted).full
    np.testing.assert_array_equal(after, before)
    scale = np.sqrt(np.outer(np.diag(before), np.diag(before)))
    np.testing.assert_allclose(used.of(wanted) / scale, before / scale, atol=1e-6)


def test_a_covariance_of_many_variables_is_the_same_by_the_graph_as_by_the_tree(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, _ = mapped_beginning("irregular/lidar16", 7, 6)
    backend, found = run.slam.backend, []
    keys = sorted({key for one in run.slam.landmarks for key in (one.key, one.anchor_key)})
    for many in (0, len(keys)):
        monkeypatch.setattr(estimator, "_MANY", many)
        backend.settle(1)  # nothing is remembered
        found.append(backend.joint_covariance(keys).full)
    scale = np.sqrt(np.outer(np.diag(found[0]), np.diag(found[0])))
    assert len(keys) > 15
    np.testing.assert_allclose(found[0] / scale, found[1] / scale, atol=1e-6)


STEP = planar_transform(1.0, 0.0, 0.0)


def at(*indices: int, step_m: float = 0.0) -> gtsam.Values:
    """Keyframes that far from one to the next."""
    return values_of(**{f"x{index}": gtsam.Pose3(gtsam.Rot3(), [step_m * index, 0, 0]) for index in indices})


def cliques(backend: Backend) -> list[set[str]]:
    """The variables of every clique of the tree, with those that it hangs on."""
    return [set(re.findall(r"x\d+", label)) for label in re.findall('label="([^"]*)"', backend._isam.dot())]


def test_what_is_asked_about_is_near_where_the_tree_begins_and_the_estimate_stays() -> None:
    backend, keys = Backend(SlamConfig().backend), [pose_symbol(index) for index in range(40)]
    for index, key in enumerate(keys):
        initial = at(index, step_m=1.0)
        step = relative_pose_factor(keys[index - 1], key, STEP, 1e-4 * np.eye(6)) if index else None
        backend.update([step or pose_prior(key, np.eye(4), np.eye(6))], initial)
    asked = [keys[3], keys[17]]
    before, poses = backend.read_joint_covariance(asked).full, backend.poses(keys)
    assert not any({"x3", "x17"} <= clique for clique in cliques(backend))
    np.testing.assert_allclose(backend.joint_covariance(asked).full, before, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(backend.poses(keys), poses, rtol=0.0, atol=1e-9)
    assert any({"x3", "x17"} <= clique for clique in cliques(backend))


def walk(backend: Backend | gtsam.ISAM2, sigmas: np.ndarray) -> list[int]:
    """Put five poses a step apart into a graph, each known so well, (x, y, z, phi, theta, psi); their keys."""
    keys = [pose_symbol(index) for index in range(5)]
    for index, key in enumerate(keys):
        there = np.linalg.matrix_power(STEP, index)
        factors = [pose_prior(key, there, np.diag(sigmas**2))]
        if index:
            factors.append(relative_pose_factor(keys[index - 1], key, STEP, 1e-4 * np.eye(6)))
        initial = at(index, step_m=1.0)
        if isinstance(backend, gtsam.ISAM2):
            backend.update(graph_of(*factors), initial)
        else:
            n_before = backend.graph.size()
            assert backend.update(factors, initial) == list(range(n_before, n_before + len(factors)))
    return keys


#: Across, it is known a hundred million times better than along and in height.
UNEVEN = np.array((1e3, 1e-5, 1e3, 1.0, 1.0, 1.0))


def test_what_cholesky_calls_indeterminate_is_solved_all_the_same() -> None:
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("CHOLESKY")
    with pytest.raises(RuntimeError, match="Indeterminate"):
        walk(gtsam.ISAM2(parameters), UNEVEN)

    backend = Backend(SlamConfig().backend)
    keys = walk(backend, UNEVEN)
    backend.update([], gtsam.Values(), remove=[8])  # the last step
    backend.update([relative_pose_factor(*keys[-2:], STEP, 1e-4 * np.eye(6))], gtsam.Values())
    coupled = np.diag([1.0, 2.0, 2.0, 2.0, 1.0]) - np.eye(5, k=1) - np.eye(5, k=-1)
    along = np.sqrt(np.diag(np.linalg.inv(np.eye(5) / UNEVEN[0] ** 2 + 1e4 * coupled)))
    for key, sigma in zip(keys, along, strict=True):
        np.testing.assert_allclose(np.sqrt(np.diag(backend.covariance(key)))[3:5], [sigma, UNEVEN[1]], rtol=1e-3)
    assert backend.graph.size() == 9


def test_a_graph_that_nothing_solves_is_refused() -> None:
    keys = pose_symbol(0), pose_symbol(1)
    with pytest.raises(BackendError, match="Indeterminate"):
        Backend(SlamConfig().backend).update([relative_pose_factor(*keys, np.eye(4), np.eye(6))], at(0, 1))


def test_a_variable_that_is_there_already_is_refused() -> None:
    backend, key = Backend(SlamConfig().backend), pose_symbol(0)
    backend.update([pose_prior(key, np.eye(4), np.eye(6))], at(0))
    with pytest.raises(BackendError, match="already exists"):
        backend.update([pose_prior(key, np.eye(4), np.eye(6))], at(0))


def test_a_covariance_that_the_tree_cannot_give_is_read_by_qr(monkeypatch: pytest.MonkeyPatch) -> None:
    backend = Backend(SlamConfig().backend)
    ends = walk(backend, np.full(6, 0.1))[::4]
    before = backend.read_joint_covariance(ends).full
    tree, ask = backend._isam, gtsam.ISAM2.jointMarginalCovariance

    def refuse(isam: gtsam.ISAM2, wanted: list[int]) -> object:
        if isam is tree:
            raise RuntimeError("Indeterminate linear system")
        return ask(isam, wanted)

    monkeypatch.setattr(gtsam.ISAM2, "jointMarginalCovariance", refuse)
    np.testing.assert_allclose(backend.read_joint_covariance(ends).full, before, rtol=1e-9, atol=1e-15)
    assert backend._isam is tree


def test_a_floor_does_not_say_where_along_it_the_body_is():
    """A push-broom laser alone: 0.55 m off for a claimed 0.03 m with planes linearised to 10 mrad, 0.11 m with 0.1."""
    run, off = mapped_beginning("hall/pushbroom/good", 960010)
    values = run.slam.backend.values
    step = run.slam.backend.graph.linearize(values).optimize()  # where the estimate is, not where iSAM2 linearised
    poses = [pose_symbol(index) for index in range(len(run.trajectory.poses))]
    assert max(np.abs(step.at(key)[3:]).max() for key in poses) < 0.05
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.2


def test_what_is_in_use_is_relinearised_at_once_and_the_rest_of_the_way_soon():
    backend, sigmas, keys = Backend(SlamConfig().backend), np.eye(6), [pose_symbol(index) for index in range(30)]
    steps = [relative_pose_factor(a, b, np.eye(4), 1e-4 * sigmas) for a, b in pairwise(keys)]
    backend.update([pose_prior(keys[0], np.eye(4), sigmas), *steps], at(*range(30)))
    there = planar_transform(0.1, 0.0, 0.0)

    def off(index: int) -> float:
        linearised = backend._isam.getLinearizationPoint().atPose3(keys[index]).matrix()
        return float(np.abs(linearised - backend.pose(keys[index])).max())

    backend.update([pose_prior(keys[-1], there, 1e-4 * sigmas)], gtsam.Values())
    assert min(off(15), off(29)) > 0.05
    backend.update([pose_prior(keys[-1], there, 1e2 * sigmas)], gtsam.Values())
    assert off(29) < 1e-3 < off(15)
    for _ in range(_ALL_EVERY):
        backend.update([pose_prior(keys[-1], there, 1e2 * sigmas)], gtsam.Values())
    assert off(15) < 1e-3


def test_where_a_pose_is_from_another_is_as_sure_as_what_lies_between() -> None:
    """However unsure both are in the world; and of one fixed to it, by perturbing it."""
    rng = np.random.default_rng(3)
    step = gtsam.Pose3.Expmap(rng.normal(0.0, 0.5, 6)).matrix()
    covariance = np.cov(rng.normal(0.0, 0.01, (6, 20)))
    backend = Backend(SlamConfig().backend)
    initial = gtsam.Values()
    for index in range(2):
        initial.insert(pose_symbol(index), gtsam.Pose3(np.linalg.matrix_power(step, index)))
    first, second = pose_symbol(0), pose_symbol(1)
    prior, between = pose_prior(first, np.eye(4), np.eye(6)), relative_pose_factor(first, second, step, covariance)
    backend.update([prior, between], initial)
    for read in (False, True):
        found, spread = backend.relative_pose(first, second, read=read)
        np.testing.assert_allclose(found, step, atol=1e-9)
        np.testing.assert_allclose(spread, covariance, atol=1e-6 * covariance.max())
    fixed = gtsam.Pose3.Expmap(rng.normal(0.0, 1.0, 6)).matrix()
    errors = np.linalg.cholesky(covariance) @ (1e-4 * np.eye(6))
    moved = [transform_from_rpy(error) for error in errors.T]
    seen = np.array([displacement(step @ fixed, step @ one @ fixed) for one in moved]) / 1e-4
    np.testing.assert_allclose(seen.T @ seen, carried(covariance, fixed), atol=1e-3 * covariance.max())
