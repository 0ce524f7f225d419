"""Keyframes that leave the graph: where the map is known, and without anything being counted twice."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_distribution

from factors.association.observations import PlaneObservation
from slam import PlaneSlam, SlamConfig
from slam.config import ThinningConfig
from slam.diagnostics.evidence.innovations import odometry_evidence
from slam.frontend.odometry import Motion, spatial_covariance
from slam.geometry.frames import planar_transform
from slam.map.sparsification import PoseSupport, _seen, chained
from slam.planeslam import pose_symbol
from slam.sensors.wheel_noise import OdometryNoise
from slam.simulation.robots import spinning_rig
from spplanes import Plane
from tests.slam.scenes import Drive, drive, planar_nees, room_planes, run_of
from tests.statistics import mean_nees_band

LAPS, PER_LAP = 5, 16
RULES = ThinningConfig(passes=2, radius_m=0.5, apart=8, max_news=0.1)


def laps(seed: int) -> Drive:
    """So many times round the room."""
    return drive(seed, count=LAPS * PER_LAP + 1, turns=LAPS)


def run(scene: Drive, rules: ThinningConfig = RULES) -> PlaneSlam:
    return run_of(scene.keyframes, PlaneSlam(SlamConfig(thinning=rules)))


def nees(slam: PlaneSlam, scene: Drive, index: int) -> float:
    """Of the pose of a keyframe, in the plane."""
    covariance, estimate = slam.marginal_covariance(pose_symbol(index)), slam.trajectory.poses[index]
    return planar_nees(covariance, scene.world_T_body[index], estimate)


@pytest.fixture(scope="module")
def thinned() -> list[tuple[PlaneSlam, Drive]]:
    return [(run(scene), scene) for scene in map(laps, range(3))]


def test_the_graph_stops_growing_where_the_map_is_known(thinned):
    for slam, scene in thinned:
        held = len(scene.keyframes) - slam.backend.n_left
        assert PER_LAP * 2 <= held < PER_LAP * 3.5 and len(slam.landmarks) == 6
        assert len(slam.trajectory.poses) == len(scene.keyframes)


def test_a_pose_that_left_is_as_honest_as_one_that_stayed(thinned):
    gone = [
        nees(slam, scene, index)
        for slam, scene in thinned
        for index in range(3, len(scene.keyframes), 5)
        if not slam.backend.holds(pose_symbol(index))
    ]
    # keyframes of one drive share the errors of its map: fewer are independent than there are
    low, high = mean_nees_band(3 * len(thinned), 3)
    assert len(gone) > 20 and low < np.mean(gone) < high


def test_what_left_is_in_no_factor_and_the_odometry_through_it_is_in_one(thinned):
    slam, scene = thinned[0]
    held = [index for index in range(len(scene.keyframes)) if slam.backend.holds(pose_symbol(index))]
    poses = {pose_symbol(index) for index in range(len(scene.keyframes))}
    steps, seen, graph = [], 0, slam.backend.graph
    for keys in (set(graph.at(i).keys()) for i in range(graph.size())):
        assert not any(not slam.backend.holds(key) for key in keys & poses)
        if len(keys) == 2 and keys <= poses:
            steps.append(tuple(sorted(keys)))
        seen += any(landmark.key in keys for landmark in slam.landmarks)
    assert sorted(steps) == [(pose_symbol(a), pose_symbol(b)) for a, b in pairwise(held)]
    assert seen == sum(len(landmark.sightings) for landmark in slam.landmarks) == 6 * len(held)
    assert all(landmark.n_keyframes == len(scene.keyframes) for landmark in slam.landmarks)


def test_the_map_is_hardly_worse_and_claims_no_more_than_with_every_keyframe(thinned):
    slam, scene = thinned[0]
    whole = run(scene, ThinningConfig(passes=0))
    assert whole.backend.n_left == 0
    for ours, theirs in zip(slam.planes, whole.planes, strict=True):
        assert np.all(np.diag(ours.plane.covariance) > 0.9 * np.diag(theirs.plane.covariance))
        assert np.all(np.diag(ours.plane.covariance) < 4.0 * np.diag(theirs.plane.covariance))
    away = slam.trajectory.poses[:, :2, 3] - whole.trajectory.poses[:, :2, 3]
    assert np.sqrt((away**2).sum(axis=1).mean()) < 0.003


def test_the_evidence_of_odometry_asks_only_for_poses_that_the_graph_holds(thinned):
    for slam, scene in thinned:
        assert any(not slam.backend.holds(pose_symbol(index)) for index in range(len(scene.keyframes)))
        assert all(one.p_value > 1e-3 for one in odometry_evidence(slam, spinning_rig()))  # honest, and no KeyError


def test_a_thinned_graph_goes_on_after_a_batch():
    scene, slam = laps(7), PlaneSlam(SlamConfig(thinning=RULES))
    for index, frame in enumerate(scene.keyframes):
        if index == 60:
            slam.adopt_batch()
        slam.add_keyframe(frame)
    assert slam.backend.n_left > 20 and nees(slam, scene, len(scene.keyframes) - 1) < chi2_distribution.isf(1e-4, 3)


def test_two_motions_in_one_are_what_the_noise_model_says_of_both():
    noise = OdometryNoise(scale_sigma=0.03, curvature_sigma_rad_per_m=0.02)
    steps = np.array([[0.5, 0.02, 0.3], [0.4, -0.03, -0.5]])
    total, covariance = noise.accumulate(steps)

    def motion(deltas: np.ndarray) -> Motion:
        whole, spread = noise.accumulate(deltas)
        sigmas = (1e-3, 2e-3, 2e-3)
        return Motion(planar_transform(*whole), spread, sigmas, noise.response(deltas), noise.calibration_sigmas)

    both = chained(motion(steps[:1]), motion(steps[1:]))
    np.testing.assert_allclose(both.a_T_b, planar_transform(*total), atol=1e-12)
    np.testing.assert_allclose(both.covariance, covariance, atol=3e-8)  # the floor of a motion of nothing, twice
    assert both.response is not None
    np.testing.assert_allclose(both.response, noise.response(steps), atol=1e-12)
    assert both.out_of_plane_sigmas[1] == pytest.approx(np.hypot(2e-3, 2e-3))

    out = (1e-3, 1e-3, 1e-3)
    own = OdometryNoise().accumulate(steps)[1]  # errors of calibration are shared only where a response says so
    plain = [OdometryNoise().covariance(step) for step in steps]
    a, b = (
        Motion(planar_transform(*step), spatial_covariance(one, planar_transform(*step), out), out)
        for step, one in zip(steps, plain, strict=True)
    )
    turned, turn = chained(a, b).covariance[np.ix_([0, 1, 3], [0, 1, 3])], np.eye(3)
    turn[:2, :2] = both.a_T_b[:2, :2]
    np.testing.assert_allclose(turn @ turned @ turn.T, own, atol=3e-8)


def test_what_was_seen_is_needed_until_all_directions_have_been_seen_again():
    step = Motion(planar_transform(0.5, 0.0, 0.0), np.diag((1e-4, 1e-4, 1e-4)), (1e-3, 1e-3, 1e-3))
    known = np.diag((1e-5, 1e-5, 1e-5))
    planes = [PlaneObservation(Plane(one.frame, known, 100, one.outline)) for one in room_planes()]
    sides, footing = [one for one in planes if abs(one.plane.normal[0]) < 0.5], PoseSupport()
    footing.step(0, None, [])
    for keyframe in range(1, 6):
        footing.step(keyframe, step, planes)
    assert footing.needed_from >= 3
    for keyframe in range(6, 20):  # a corridor: nothing along it
        footing.step(keyframe, step, sides)
    assert footing.needed_from <= 6
    for keyframe in range(20, 24):
        footing.step(keyframe, step, planes)
    assert footing.needed_from >= 20


@pytest.mark.parametrize("orders", [3, 7])
def test_what_is_told_very_well_of_a_pose_that_is_unknown_leaves_a_covariance(orders: int):
    """Where fourteen orders lie between what is known and what is not, a difference of inverses is no covariance."""
    rng = np.random.default_rng(3)
    basis = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    covariance = (basis * np.logspace(0, orders, 6)) @ basis.T
    covariance = 0.5 * (covariance + covariance.T)
    for told in (1, 3):
        normals = rng.standard_normal((told, 6))
        information = 10.0**orders * normals.T @ normals
        seen = _seen(covariance, information)
        np.linalg.cholesky(seen)
        assert np.array_equal(seen, seen.T)
        if orders == 3:
            assert np.allclose(seen, np.linalg.inv(np.linalg.inv(covariance) + information), atol=1e-8)
