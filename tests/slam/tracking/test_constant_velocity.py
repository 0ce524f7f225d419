"""Constant velocity: how far the next motion may be from the one before, and that it errs as that one does."""

import gtsam
import numpy as np
import pytest

from factors._conventions import POSE3_TO_SP
from factors.association.observations import PlaneObservation
from slam import Keyframe, PlaneSlam
from slam.backend.estimator import pose_symbol
from slam.backend.joint_covariance import relative_covariance
from slam.config import CoastingConfig
from slam.geometry.frames import inverse
from slam.tracking.prediction import coast
from tests.slam.registration.test_plane_registration import body, hall, measured
from tests.statistics import mean_nees_band

RULES = CoastingConfig()
N = 3000


def exp(tangent: np.ndarray) -> np.ndarray:
    """Pose of a tangent in SP order, as all here."""
    return gtsam.Pose3.Expmap(tangent[np.argsort(POSE3_TO_SP)]).matrix()


def log(pose: np.ndarray) -> np.ndarray:
    return gtsam.Pose3.Logmap(gtsam.Pose3(pose))[POSE3_TO_SP]


@pytest.mark.parametrize(("before_s", "ahead_s"), [(0.5, 0.5), (0.25, 0.5)])
def test_the_next_motion_errs_by_its_acceleration_and_as_the_motion_before(before_s: float, ahead_s: float) -> None:
    """Mean chi2 of 3,000 motions, the one before known along two directions better than along the others."""
    rng = np.random.default_rng(1)
    root = 0.03 * np.tril(rng.standard_normal((6, 6)))
    spread = {"acceleration_sigma_m_per_s2": 0.2, "turn_change_sigma_rad_per_s2": 0.14, "floor_rad": 0.001}
    rules = RULES.model_copy(update=spread)
    sigmas = np.repeat([rules.acceleration_sigma_m_per_s2, rules.turn_change_sigma_rad_per_s2], 3) * ahead_s**2
    found, without = [], []
    for _ in range(N):
        velocity = 0.05 * rng.standard_normal(6)
        seen = exp(velocity) @ exp(root @ rng.standard_normal(6))
        true = exp(velocity * ahead_s / before_s + sigmas * rng.standard_normal(6))
        motion = coast(seen, before_s, ahead_s, rules, root @ root.T)
        off = log(inverse(motion.a_T_b) @ true)
        found.append(off @ np.linalg.solve(motion.covariance, off))
        without.append(off @ np.linalg.solve(coast(seen, before_s, ahead_s, rules).covariance, off))
    low, high = mean_nees_band(N, 6, level=0.998)
    assert 0.97 * low < np.mean(found) < 1.03 * high  # to first order in the motion
    assert np.mean(without) > 1.5 * high


def test_without_a_motion_before_the_speed_is_unknown() -> None:
    motion = coast(None, 0.0, 0.5, RULES)
    assert np.array_equal(motion.a_T_b, np.eye(4))
    stated = np.repeat([RULES.speed_sigma_m_per_s, RULES.turn_sigma_rad_per_s], 3) * 0.5
    assert np.allclose(np.sqrt(np.diag(motion.covariance)), stated)


def test_covariance_of_a_relative_pose() -> None:
    """Against 20,000 draws of both poses, whose errors go together."""
    rng = np.random.default_rng(2)
    poses = [exp(0.4 * rng.standard_normal(6)) for _ in range(2)]
    root = 0.01 * rng.standard_normal((12, 12))
    relative, drawn = inverse(poses[0]) @ poses[1], []
    for tangent in (rng.standard_normal((20_000, 12)) @ root.T).reshape(-1, 2, 6):
        a, b = (pose @ gtsam.Pose3.Expmap(one).matrix() for pose, one in zip(poses, tangent, strict=True))
        drawn.append(log(inverse(relative) @ inverse(a) @ b))
    expected = relative_covariance(relative, root @ root.T)
    assert np.abs(np.cov(np.array(drawn).T) - expected).max() < 0.04 * np.diag(expected).max()


def test_a_body_that_nobody_sees_move_for_a_while_is_where_its_velocities_before_and_after_lead() -> None:
    """Ten drives past a bare stretch of wall, on which the body stops and drives back: to 5 cm, and as it claims.

    By motions copied from the one before, each with an error of its own, it was half a metre off where the gable came
    into sight again, which was then another one.
    """
    floor, _, side, _, gable, _ = hall()
    steps, bare, nees = 30, range(8, 22), []
    for seed in range(10):
        rng, slam, way_m, true = np.random.default_rng(seed), PlaneSlam(), 2.0, []
        for k in range(steps):
            true.append(body(way_m, 0.5, 0.3))
            seen = measured([floor, side] if k in bare else [floor, side, gable], true[-1], rng)
            slam.add_keyframe(Keyframe(k * 100_000_000, [PlaneObservation(plane) for plane in seen]))
            way_m += 0.05 * np.cos(np.pi * k / steps)
        poses = slam.trajectory.poses
        off = np.array([(inverse(poses[k]) @ poses[0] @ inverse(true[0]) @ true[k])[:3, 3] for k in range(steps)])
        assert len(slam.planes) == 3
        assert np.linalg.norm(off, axis=1).max() < 0.05
        k = bare[len(bare) // 2]
        nees.append(off[k] @ np.linalg.solve(slam.marginal_covariance(pose_symbol(k))[3:, 3:], off[k]))
    low, high = mean_nees_band(10, 3, level=0.998)
    assert low < np.mean(nees) < high


def test_past_a_stretch_of_nothing_a_body_may_be_off_by_all_of_the_way_there() -> None:
    """In sight it starts where it was seen; out of sight it drifts by more than its last motion errs."""
    rng, slam, adrift, before = np.random.default_rng(0), PlaneSlam(), [], []
    for k in range(16):
        seen = measured(hall(), body(2.0 + 0.1 * k, 0.5, 0.3), rng) if k < 10 else []
        keyframe = Keyframe(k * 300_000_000, [PlaneObservation(plane) for plane in seen])
        if k > 1:
            prior = slam._motion_model._unmeasured(keyframe, k - 1, 0.3, 0.3)
            adrift.append(prior.adrift[:3])
            before.append(prior.before[:3])
        slam.add_keyframe(keyframe)
    assert np.abs(adrift[:9]).max() < 1e-12
    assert np.all(np.diff(adrift[8:], axis=0) > 0.0)
    assert np.all(np.array(adrift[-1]) > 2.0 * np.array(before[-1]))
