"""A body that keeps its velocity while nobody sees it: derivatives, and what is claimed of where it is."""

import gtsam
import numpy as np
import pytest

from factors import constant_velocity_factor, pose_prior, relative_pose_factor
from factors._conventions import SP_TO_POSE3
from tests.factors.factor_scenes import assert_jacobian, graph_of, random_pose, values_of
from tests.statistics import mean_nees_band

A, B, C = (gtsam.symbol("x", i) for i in range(3))
#: Of a change of the motion, and of what is known of a pose that is seen, SP order.
CHANGE = np.repeat([0.02, 0.01], 3) ** 2
SEEN = np.repeat([1e-3, 5e-4], 3) ** 2
#: Steps of a drive, of which the first few poses are seen.
STEPS, FIRST = 16, 3


def exp(tangent: np.ndarray) -> gtsam.Pose3:
    """Pose of a tangent in SP order."""
    return gtsam.Pose3.Expmap(tangent[SP_TO_POSE3])


def along(*poses: gtsam.Pose3) -> gtsam.Values:
    return values_of(**{f"x{i}": pose for i, pose in enumerate(poses)})


def drive(rng: np.random.Generator, kept: float) -> list[gtsam.Pose3]:
    """Poses of a body that changes its motion a little at every step."""
    poses, motion = [gtsam.Pose3()], exp(np.array([0.2, 0.0, 0.0, 0.02, 0.0, 0.0]))
    for _ in range(STEPS):
        poses.append(poses[-1] * motion)
        went_on = gtsam.Pose3.Expmap(kept * gtsam.Pose3.Logmap(motion))
        motion = went_on * exp(rng.standard_normal(6) * np.sqrt(CHANGE))
    return poses


def seen_at(poses: list[gtsam.Pose3], frames: range, rng: np.random.Generator) -> gtsam.NonlinearFactorGraph:
    noisy = ((k, poses[k] * exp(rng.standard_normal(6) * np.sqrt(SEEN))) for k in frames)
    return graph_of(*(pose_prior(gtsam.symbol("x", k), pose, np.diag(SEEN)) for k, pose in noisy))


def nees_of(graph: gtsam.NonlinearFactorGraph, poses: list[gtsam.Pose3], frame: int) -> tuple[float, float]:
    """NEES of a pose, and how far off it is, m."""
    found = gtsam.LevenbergMarquardtOptimizer(graph, along(*poses)).optimize()
    key = gtsam.symbol("x", frame)
    off = found.atPose3(key).localCoordinates(poses[frame])
    information = gtsam.Marginals(graph, found).marginalInformation(key)
    return float(off @ information @ off), float(np.linalg.norm(off[3:]))


def test_derivatives_at_motions_of_all_sizes() -> None:
    for seed in range(100):
        rng = np.random.default_rng(seed)
        factor = constant_velocity_factor([A, B, C], np.diag(rng.uniform(0.1, 1.0, 6)), kept=rng.uniform(0.2, 1.5, 6))
        assert_jacobian(factor, along(*(random_pose(rng) for _ in range(3))))


def test_what_goes_on_is_the_motion_in_its_own_axes_and_in_time() -> None:
    """No error where a body turns and drives on; covariance and shares are in the SP order, along the axes of c."""
    motion = exp(np.array([0.4, 0.1, -0.1, 0.3, 0.1, 0.2]))
    start = random_pose(np.random.default_rng(0))
    twice = constant_velocity_factor([A, B, C], np.eye(6), kept=2.0)
    assert twice.error(along(start, start * motion, start * motion * motion * motion)) < 1e-20
    half_yaw = constant_velocity_factor([A, B, C], np.diag([1, 4, 9, 16, 25, 36]), kept=[1, 1, 1, 0.5, 1, 1])
    turn, less = exp(np.array([0.0, 0.0, 0.0, 0.4, 0.0, 0.0])), exp(np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0]))
    aside = less * gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 2.0, 0.0]))
    assert half_yaw.error(along(start, start * turn, start * turn * less)) < 1e-20
    assert half_yaw.error(along(start, start * turn, start * turn * aside)) == pytest.approx(0.5 * 2.0**2 / 4)


@pytest.mark.parametrize("kept", [1.0, 0.9])
def test_past_a_stretch_that_nobody_saw_it_claims_what_it_errs_by(kept: float) -> None:
    """150 drives whose motion is seen again at their end: NEES of the last pose in its band.

    Motions copied from the last that was seen, each as wide as it errs, lead farther off, and claim far less than that.
    """
    ours, copied = [], []
    for seed in range(150):
        rng = np.random.default_rng(seed)
        poses = drive(rng, kept)
        seen = seen_at(poses, range(FIRST), rng)
        for k in range(STEPS - 2, STEPS):
            noisy = poses[k].between(poses[k + 1]) * exp(rng.standard_normal(6) * np.sqrt(SEEN))
            seen.push_back(relative_pose_factor(gtsam.symbol("x", k), gtsam.symbol("x", k + 1), noisy, np.diag(SEEN)))
        graph, other = gtsam.NonlinearFactorGraph(seen), gtsam.NonlinearFactorGraph(seen)
        motion = poses[FIRST - 2].between(poses[FIRST - 1])
        for k in range(STEPS - 1):
            keys = [gtsam.symbol("x", k + i) for i in range(3)]
            graph.push_back(constant_velocity_factor(keys, np.diag(CHANGE), kept=kept))
            wide = np.diag(CHANGE) * max(k + 3 - FIRST, 1)
            other.push_back(relative_pose_factor(*keys[1:], motion, wide))
        ours.append(nees_of(graph, poses, STEPS))
        copied.append(nees_of(other, poses, STEPS))
    (nees, off), (other_nees, other_off) = np.array(ours).T, np.array(copied).T
    low, high = mean_nees_band(150, 6, level=0.998)
    assert low < nees.mean() < high
    assert other_nees.mean() > 3.0 * nees.mean()
    assert np.sqrt(np.mean(off**2)) < 0.7 * np.sqrt(np.mean(other_off**2))


def test_bad_input_is_refused_in_one_sentence() -> None:
    for keys, covariance, kept, says in (
        ([A, B], np.eye(6), 1.0, "keys: expected three, got 2"),
        ([A, B, A], np.eye(6), 1.0, "expected another key"),
        ([A, B, C], np.zeros((6, 6)), 1.0, "covariance: expected a positive definite"),
        ([A, B, C], np.eye(6), np.nan, "kept"),
        ([A, B, C], np.eye(6), np.ones(3), "kept: expected shape"),
    ):
        with pytest.raises(ValueError, match=says):
            constant_velocity_factor(keys, covariance, kept=kept)
