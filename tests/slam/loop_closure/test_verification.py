"""Loops: a place seen again after a drift beyond every gate is found by its walls; the wheels' errors are learnt."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors.association.observations import LineObservation
from slam.backend.joint_covariance import motion_covariance
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion, planar_delta
from slam.frontend.wheel_calibration import WheelCalibration
from slam.geometry.frames import inverse, planar_transform
from slam.mapping.same_plane import disjoint
from slam.sensors.wheel_noise import OdometryNoise
from spplanes import ScanLine
from tests.slam.scenes import run_of

SIGMA_ALPHA, SIGMA_SHIFT, REACH = 0.003, 0.005, 7.0


def hall() -> np.ndarray:
    """Ends of the walls around a square of corridors, each seen from one side, all of other lengths, (W, 2, 2)."""
    rng, walls = np.random.default_rng(0), []
    for x, y in ((0.0, 0.0), (15.0, 0.0), (15.0, 15.0), (0.0, 15.0)):
        for direction in np.repeat(np.arange(4) * np.pi / 2, 6) + rng.uniform(-0.7, 0.7, 24):
            middle = np.array((x, y)) + rng.uniform(-4.0, 4.0, 2)
            half = rng.uniform(0.6, 1.5) * np.array((np.cos(direction), np.sin(direction)))
            walls.append((middle - half, middle + half))
    return np.array(walls)


def see(walls: np.ndarray, pose: np.ndarray, rng: np.random.Generator) -> list[LineObservation]:
    """Lines of the walls within reach that face the robot, with errors of their covariance."""
    seen = []
    for ends in (walls - pose[:2]) @ planar_transform(0.0, 0.0, pose[2])[:2, :2]:
        direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        normal = np.array((-direction[1], direction[0]))
        rho = float(ends.mean(axis=0) @ normal)
        if rho < 0.3 or np.linalg.norm(ends, axis=1).max() > REACH:
            continue
        middle = float(ends.mean(axis=0) @ np.array((-normal[1], normal[0])))
        jacobian = np.array(((1.0, 0.0), (middle, 1.0)))
        covariance = jacobian @ np.diag((SIGMA_ALPHA**2, SIGMA_SHIFT**2)) @ jacobian.T
        turn, shift = np.linalg.cholesky(covariance) @ rng.standard_normal(2)
        line = ScanLine(float(np.arctan2(normal[1], normal[0]) + turn), rho + shift, covariance, ends, np.arange(20))
        seen.append(LineObservation(line, np.eye(4)))
    return seen


def square_tour(kick: float, side: float = 15.0) -> tuple[list[Keyframe], np.ndarray]:
    """Once round the square and a bit more; on 10 m of it nothing is seen and the heading errs by `kick` (rad) more."""
    rng = np.random.default_rng(1)
    leg, along = np.divmod(np.arange(0.0, 4.0 * side + 8.0, 0.5), side)
    corners, heading = np.array(((0, 0), (side, 0), (side, side), (0, side), (0, 0))), leg * np.pi / 2
    xy = corners[leg.astype(int) % 4] + along[:, None] * np.stack((np.cos(heading), np.sin(heading)), axis=1)
    poses = np.array([planar_transform(x, y, t) for (x, y), t in zip(xy, heading, strict=True)])
    walls, noise, frames = hall(), OdometryNoise(), []
    for index, pose in enumerate(poses):
        delta = planar_delta(inverse(poses[index - 1]) @ pose)
        wrong = delta + np.array((0.0, 0.0, kick / 20.0 * (50 <= index < 70)))
        motion = Motion(planar_transform(*wrong), noise.covariance(delta), (1e-3, 1e-3, 1e-3)) if index else None
        seen = [] if 50 <= index < 70 else see(walls, np.array((*xy[index], heading[index])), rng)
        frames.append(Keyframe(index * 10**9, seen, motion, pose if index == 0 else None))
    return frames, poses


def test_a_drift_beyond_the_gates_is_closed_by_the_constellation():
    """Without it the tour ends 2.6 m off, with 85 landmarks."""
    frames, poses = (one[:126] for one in square_tour(kick=0.2))
    slam = run_of(frames)
    closed = [decision for decision in slam.loops if decision.verdict == "closed"]
    assert closed and all(len(decision.pairs) >= 3 and decision.evidence > 7.0 for decision in closed)
    assert np.linalg.norm((slam.trajectory.poses - poses)[-1, :2, 3]) < 0.1 and len(slam.landmarks) < 75


def test_every_comparison_is_recorded_and_a_tour_without_a_return_closes_nothing():
    slam = run_of(square_tour(kick=0.0)[0][:60])
    assert not [decision for decision in slam.loops if decision.verdict == "closed"]
    assert all(decision.keyframe > decision.old_keyframe for decision in slam.loops)


def test_pairs_that_share_a_landmark_are_joined_once():
    assert disjoint([(0, 1), (1, 2), (3, 4)]) == [(0, 1), (3, 4)]


UNKNOWN_WHEELS = OdometryNoise(scale_sigma=0.04, curvature_sigma_rad_per_m=0.07)


def driven(step: np.ndarray) -> Motion:
    """A step (x, y, theta) as such wheels measure it."""
    response = UNKNOWN_WHEELS.response([step])
    covariance, sigmas = UNKNOWN_WHEELS.covariance(step), UNKNOWN_WHEELS.calibration_sigmas
    return Motion(planar_transform(*step), covariance, (1e-3,) * 3, response, sigmas)


@pytest.mark.parametrize("errors", [(0.03, -0.05), (-0.02, 0.06)])
def test_the_wheels_errors_are_learnt_and_honestly(errors):
    """NEES of (scale, curvature) after 60 motions seen with known covariance."""
    rng, calibration, seen = np.random.default_rng(3), WheelCalibration(), np.diag((0.005, 0.005, 0.005)) ** 2
    for _ in range(60):
        step = np.array((rng.uniform(0.2, 1.0), 0.0, rng.normal(0.0, 0.2)))
        motion = driven(step)
        predicted = calibration.predict(motion)
        random = UNKNOWN_WHEELS.random_covariances([step])[0] + 1e-10 * np.eye(3)
        truth = step + motion.response @ np.array(errors) + np.linalg.cholesky(random) @ rng.standard_normal(3)
        measured = truth + np.linalg.cholesky(seen) @ rng.standard_normal(3)
        gain = predicted.covariance @ np.linalg.inv(predicted.covariance + seen)
        fused = planar_delta(predicted.a_T_b) + gain @ (measured - planar_delta(predicted.a_T_b))
        calibration.learn(predicted, planar_transform(*fused), predicted.covariance - gain @ predicted.covariance)
    assert calibration.covariance is not None
    error = calibration.mean - np.array(errors)
    assert error @ np.linalg.solve(calibration.covariance, error) < 13.8
    assert np.sqrt(np.diag(calibration.covariance))[1] < 0.01


def test_nothing_seen_teaches_nothing():
    motion, calibration = driven(np.array((1.0, 0.0, 0.1))), WheelCalibration()
    predicted, before = calibration.predict(motion), calibration.covariance.copy()
    calibration.learn(predicted, predicted.a_T_b, predicted.covariance)
    assert np.allclose(calibration.mean, 0.0)
    np.testing.assert_allclose(calibration.covariance, before, atol=1e-12)
    plain = replace(motion, response=None)
    assert calibration.predict(plain) is plain


def test_the_covariance_of_a_motion_agrees_with_sampled_poses():
    rng = np.random.default_rng(4)
    root = 1e-3 * rng.normal(size=(12, 12))
    a, b = gtsam.Pose3(planar_transform(1.0, 2.0, 0.7)), gtsam.Pose3(planar_transform(1.5, 2.9, 1.3))
    a_T_b, sampled = a.between(b).matrix(), []
    for _ in range(20000):
        tangent = root @ rng.standard_normal(12)
        sampled.append(planar_delta(a.retract(tangent[:6]).between(b.retract(tangent[6:])).matrix()))
    expected = np.cov(np.array(sampled).T)
    np.testing.assert_allclose(motion_covariance(a_T_b, root @ root.T), expected, rtol=0.05, atol=3e-7)
