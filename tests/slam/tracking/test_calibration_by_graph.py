"""Errors of calibration by the graph: found where they are, honest, exact, and in every covariance that is read."""

from dataclasses import dataclass

import gtsam
import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from factors import pose_prior
from slam.backend.estimator import Backend, pose_symbol
from slam.config import BackendConfig, SlamConfig
from slam.frontend.odometry import Motion, OdometryTrack, planar_delta
from slam.frontend.wheel_calibration import WheelCalibration, unknown_at_first
from slam.geometry.frames import inverse, planar_transform
from slam.map.sparsification import MeasuredStep, Sparsifier, chained
from slam.runs.slam_run import run_slam
from slam.sensors.log import OdometryReading
from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS, OdometryNoise
from slam.tracking.calibration_by_graph import CalibrationByGraph, calibration_by_graph
from spplanes._check import FloatArray
from tests.slam.short_drives import mapped_beginning
from tests.statistics import assert_mean_in_band

_PRIOR = np.array(UNCALIBRATED_WHEELS.calibration_sigmas)
#: A rig that states no errors of calibration.
NOISE = OdometryNoise(z_sigma_m=1e-3, pitch_sigma_rad=1e-3, roll_sigma_rad=1e-3)
N_POSES = 60
#: Standard deviations of what is seen of a pose: where it is, m, and how it is turned, rad.
SEEN_M, SEEN_RAD = 0.02, 0.01


@dataclass(frozen=True, eq=False)
class Chain:
    """A graph, and the truth."""

    backend: Backend
    steps: list[MeasuredStep]  # the odometry in it
    true: FloatArray  # world poses (N, 4, 4)


def chain(
    rng: np.random.Generator,
    errors: FloatArray,
    *,
    seen_every: int = 10,
    until: int | None = None,
    stated: bool = False,
    noise: OdometryNoise = NOISE,
    along_m: float = SEEN_M,
    turns_rad: float = 0.1,
) -> Chain:
    """Half a metre a step, turning; every so many poses are seen, none from one on.

    `errors` are the scale and curvature that take measured motions to true ones; `stated` is a rig that says how large
    they may be, `UNCALIBRATED_WHEELS` as of a robot nobody describes; `noise` is their random walk, and `along_m` how
    well what is seen tells x.
    """
    backend, motions, indices, true = Backend(BackendConfig()), [], [], [np.eye(4)]
    sigmas = UNCALIBRATED_WHEELS.calibration_sigmas if stated else NOISE.calibration_sigmas
    factors, values, at = [], gtsam.Values(), np.eye(4)
    for k in range(N_POSES):
        if k:
            moved = np.array((0.5, 0.0, rng.normal(0.0, turns_rad)))
            true.append(true[-1] @ planar_transform(*moved))
            measured = noisy = moved + np.linalg.cholesky(noise.covariance(moved)) @ rng.standard_normal(3)
            for _ in range(4):  # so that it is, corrected by the errors, what it is without them
                measured = noisy - noise.response([measured]) @ errors
            response, random = noise.response([measured]), noise.covariance(measured)
            wide = random + response @ np.diag(np.square(sigmas)) @ response.T
            motion = Motion(planar_transform(*measured), wide, (1e-3,) * 3, response, sigmas)
            motions.append((motion, len(indices) + len(factors)))
            factors += motion.factors(pose_symbol(k - 1), pose_symbol(k))[:1]
            at = at @ motion.a_T_b
        if k % seen_every == 0 and (until is None or k < until):
            factors.append(seen(rng, k, true[-1], exact=k == 0, along_m=along_m))
        values.insert(pose_symbol(k), gtsam.Pose3(at))
        if k % seen_every == 0 or k == N_POSES - 1:
            indices += backend.update(factors, values)
            factors, values, at = [], gtsam.Values(), backend.pose(pose_symbol(k))
    backend.settle(10)
    steps = [MeasuredStep(k, k + 1, motion, indices[place]) for k, (motion, place) in enumerate(motions)]
    return Chain(backend, steps, np.array(true))


def seen(
    rng: np.random.Generator, k: int, true: FloatArray, *, exact: bool = False, along_m: float = SEEN_M
) -> gtsam.NonlinearFactor:
    """A look that tells a pose, world_T_body (4, 4), as well as looks do, and its x to `along_m`."""
    sigmas = np.array([SEEN_M if exact else along_m, SEEN_M, 1e-2, SEEN_RAD, 1e-2, 1e-2])
    off = np.zeros(6) if exact else sigmas * rng.standard_normal(6)
    x, y, heading = planar_delta(true) + off[[0, 1, 3]]
    return pose_prior(pose_symbol(k), planar_transform(x, y, heading), np.diag(sigmas**2))


def calibrated(made: Chain) -> Chain:
    """The chain with what the graph says of its wheels, as a run has it."""

    class Steps(Sparsifier):
        def __init__(self) -> None:
            self.steps = made.steps
            self.n_measured = len(self.steps)

        def measured_steps(self):
            return self.steps

        def relinked(self, steps, factor_indices):
            both = zip(steps, factor_indices, strict=True)
            self.steps = [step._replace(factor_index=index) for step, index in both]

    assert CalibrationByGraph(Steps(), made.backend, WheelCalibration()).learn() is not None
    return made


def test_errors_of_calibration_are_honest_and_what_a_rig_states_is_believed() -> None:
    """Drawn as the prior has them: NEES with 2 degrees of freedom. Where there are none, seldom are any found."""
    rng, nees, missed = np.random.default_rng(1), [], 0
    for _ in range(50):  # twice or half the covariance is off its band in 99 of 100
        errors = _PRIOR * rng.standard_normal(2)
        made = chain(rng, errors)
        found, _ = calibration_by_graph(made.steps, made.backend)
        off = found.mean - errors
        nees.append(off @ np.linalg.solve(found.covariance, off))
        missed += found.as_stated > 0.05 and bool(np.any(np.abs(errors) > 6.0 * np.sqrt(np.diag(found.covariance))))
    assert_mean_in_band(np.array(nees), 2)
    assert missed == 0
    stated = [calibration_by_graph(one.steps, one.backend)[0] for one in (chain(rng, np.zeros(2)) for _ in range(30))]
    assert sum(found.as_stated < 0.05 for found in stated) <= 2
    assert np.median([found.as_stated for found in stated]) > 0.9


def test_a_scale_that_nothing_tells_is_not_found() -> None:
    """Along a bare corridor: how far it went across, by noise alone, would be explained by a scale of -1."""
    noise = NOISE.model_copy(update={"lateral_sigma_m_per_sqrt_m": 0.03})
    corridor = {"seen_every": 1, "stated": True, "noise": noise, "along_m": 1e3, "turns_rad": 0.002}
    rng, means = np.random.default_rng(7), []
    for _ in range(20):
        made = chain(rng, np.zeros(2), **corridor)
        found, _ = calibration_by_graph(made.steps, made.backend)
        assert found.covariance[0, 0] > 0.85 * _PRIOR[0] ** 2
        means.append(found.mean[0] / _PRIOR[0])
    assert abs(np.mean(means)) < 0.2


@pytest.mark.parametrize("stated", [False, True], ids=["unstated", "stated"])
def test_what_steps_share_is_in_the_covariances_exactly(stated: bool) -> None:
    """The graph with the errors as a variable of its own, solved as one: the same marginals."""
    made = calibrated(chain(np.random.default_rng(2), np.array((0.03, -0.05)), until=31, stated=stated))
    unknown, backend = gtsam.symbol("c", 0), made.backend
    whole, graph = gtsam.GaussianFactorGraph(), backend.graph.linearize(backend.values)
    for index in range(graph.size()):
        factor = graph.at(index)
        keys = list(factor.keys())
        if len(keys) == 2:  # a step: its errors of calibration move its end, along the axes there
            (step,) = [one for one in made.steps if {pose_symbol(one.before), pose_symbol(one.keyframe)} == set(keys)]
            jacobian, target = factor.jacobian()
            blocks = dict(zip(keys, (jacobian[:, :6], jacobian[:, 6:]), strict=True))
            by_errors, response = np.zeros((6, 2)), step.motion.response
            by_errors[[3, 4]], by_errors[2] = step.motion.a_T_b[:2, :2].T @ response[:2], response[2]
            ends = [part for key in keys for part in (key, blocks[key])]
            by_errors = -blocks[pose_symbol(step.keyframe)] @ by_errors
            noise = gtsam.noiseModel.Unit.Create(len(target))
            factor = gtsam.JacobianFactor(*ends, unknown, by_errors, target, noise)
        whole.push_back(factor)
    prior = np.diag(1.0 / np.sqrt(np.diag(unknown_at_first(made.steps[0].motion))))
    whole.push_back(gtsam.JacobianFactor(unknown, prior, np.zeros(2), gtsam.noiseModel.Unit.Create(2)))
    keys = [pose_symbol(k) for k in (12, 30, 59)]
    exact = np.linalg.inv(whole.marginal(keys).hessian(gtsam.Ordering(keys))[0])
    sigmas = np.sqrt(np.diag(exact))
    scale = np.outer(sigmas, sigmas)
    np.testing.assert_allclose(backend.read_joint_covariance(keys).full / scale, exact / scale, atol=5e-3)
    blind = backend.read_joint_covariance(keys, shared=False).full
    assert exact[16, 16] > 1.5 * blind[16, 16]  # across the way, far from what was seen: it does matter
    alone = backend.read_joint_covariance([keys[1]]).full
    np.testing.assert_allclose(backend.read_covariance(keys[1]), alone, rtol=1e-6)


@pytest.mark.parametrize("stated", [False, True], ids=["unstated", "stated"])
def test_poses_far_from_what_was_seen_are_honest(stated: bool) -> None:
    """After half the way nothing is seen: what is left open about the wheels moves all that follows alike."""
    rng, nees, blind = np.random.default_rng(3), [], []
    while len(nees) < 30:  # twice or half the covariance is off its band in 98 of 100
        errors = _PRIOR * rng.standard_normal(2)
        if not stated and np.abs(errors / _PRIOR).max() < 1.0:
            continue  # hardly to be told from none
        made = calibrated(chain(rng, errors, until=31, stated=stated))
        key = pose_symbol(len(made.true) - 1)
        off = planar_delta(inverse(made.backend.pose(key)) @ made.true[-1])
        told, without = made.backend.read_covariance(key), made.backend.read_joint_covariance([key], shared=False).full
        for covariance, into in ((told, nees), (without, blind)):
            into.append(off @ np.linalg.solve(covariance[np.ix_([3, 4, 2], [3, 4, 2])], off))
    assert_mean_in_band(np.array(nees), 3)
    assert np.mean(blind) > 4.5


def test_what_is_seen_after_the_graph_was_asked_is_counted_too() -> None:
    """As after a loop: the steps have errors that are no longer the likeliest, until the graph is asked again."""
    rng, nees = np.random.default_rng(5), []
    while len(nees) < 30:
        errors = _PRIOR * rng.standard_normal(2)
        made = chain(rng, errors, until=11)
        if calibration_by_graph(made.steps, made.backend)[0].as_stated >= 0.5:
            continue
        calibrated(made)
        made.backend.update([seen(rng, k, made.true[k]) for k in (20, 30, 40)], gtsam.Values(), relinearize=True)
        made.backend.settle(10)
        key = pose_symbol(len(made.true) - 1)
        off = planar_delta(inverse(made.backend.pose(key)) @ made.true[-1])
        nees.append(off @ np.linalg.solve(made.backend.read_covariance(key)[np.ix_([3, 4, 2], [3, 4, 2])], off))
    assert np.mean(nees) < 4.3  # the upper end of the band of 3 degrees of freedom; it may claim less than it knows
    assert np.mean(nees) > 1.5


def test_what_the_graph_found_stays_until_it_is_asked_again() -> None:
    """Only what a rig states is learnt step by step: after a stretch where nothing was seen that went to NaN."""
    calibration, found = WheelCalibration(), np.diag((0.003, 0.003)) ** 2
    calibration.share(np.array((0.02, -0.02)), found.copy())
    for step in chain(np.random.default_rng(6), np.zeros(2)).steps:
        np.testing.assert_array_equal(calibration.predict(step.motion).covariance, step.motion.covariance)
    np.testing.assert_array_equal(calibration.covariance, found)
    np.testing.assert_array_equal(calibration.mean, (0.02, -0.02))


def test_the_response_of_a_motion_in_space_and_of_motions_in_a_row() -> None:
    """By differences: readings whose ways and turns err by a little, over a ramp."""

    def track(scale: float, curvature: float) -> OdometryTrack:
        pose, readings = np.eye(4), [OdometryReading(0, np.eye(4))]
        for k in range(1, 9):
            way, turn, pitch = 0.3 * (1.0 + scale), 0.05 + curvature * 0.3, -0.02 if k < 5 else 0.02
            pose = pose @ gtsam.Pose3(gtsam.Rot3.Ypr(turn, pitch, 0.0), np.array((way, 0.0, 0.0))).matrix()
            readings.append(OdometryReading(k * 10**8, pose))
        return OdometryTrack(readings, OdometryNoise())

    def ends(one: OdometryTrack) -> tuple[np.ndarray, np.ndarray]:
        return one.motion(0, 8 * 10**8), chained(one.motion(0, 4 * 10**8), one.motion(4 * 10**8, 8 * 10**8))

    whole, parts = ends(track(0.0, 0.0))
    assert not whole.is_planar
    np.testing.assert_allclose(parts.a_T_b, whole.a_T_b, atol=1e-12)
    np.testing.assert_allclose(parts.response, whole.response, atol=0.01)  # a ramp is a little longer than its plan
    for errors in ((0.01, 0.0), (0.0, 0.01)):
        calibration, erring = WheelCalibration(), ends(track(*errors))[0].a_T_b
        calibration.share(np.array(errors), np.diag((1e-6, 1e-6)))
        for motion in (whole, parts):
            moved = calibration.corrected(motion)
            off, was = (planar_delta(inverse(one.a_T_b) @ erring) for one in (moved, motion))
            assert np.linalg.norm(off) < 0.12 * np.linalg.norm(was)
            np.testing.assert_array_equal(moved.covariance, motion.covariance)


def test_a_rig_that_states_a_scale_and_no_curvature() -> None:
    """Half of the unknown is known to be nothing: no NaN, nothing found of it, and covariances as of a scale alone."""
    drive = make_drive(Recipe.parse("bare/level/undescribed"), 211004)
    stated = drive.rig.odometry.model_copy(update={"scale_sigma": 0.04, "curvature_sigma_rad_per_m": 0.0})
    run = run_slam(drive.log, drive.rig.model_copy(update={"odometry": stated}), SlamConfig(), repair=False)
    assert run.slam.calibration.mean[1] == 0.0 and 0.03 < np.sqrt(run.slam.calibration.covariance[0, 0]) <= 0.04
    last = run.slam.marginal_covariance(pose_symbol(len(run.slam.keyframes) - 1))
    assert 0.5 < np.sqrt(np.linalg.eigvalsh(last[3:, 3:])[-1]) < 1.5  # 0.04 of 21 m


def test_biased_wheels_are_found_out_on_a_drive() -> None:
    """Heading drifts by 1.1 deg/m, ways are 3 % off, unstated: 0.10 m off, with sigmas of 0.04, were it not asked."""
    run, errors = mapped_beginning("office/depth/biased", 710002, 40)
    assert np.linalg.norm(errors[:, :3, 3], axis=1).max() < 0.07
    off = inverse(errors[-1])[:3, 3]
    covariance = run.slam.marginal_covariance(pose_symbol(len(errors) - 1))[3:, 3:]
    assert off @ np.linalg.solve(covariance, off) < 16.3
