"""Measurements of a pose beside its planes: they reach the graph, the session, and leave with their keyframe."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam import Keyframe, PlaneSlam
from slam.frontend.pose_measurements import GravityMeasurement
from slam.planeslam import pose_symbol
from slam.session.store import Session
from tests.statistics import assert_mean_in_band

SIGMA = 0.01


def leaning(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A pose with any heading and some lean, and the direction against gravity as an IMU there measures it."""
    pose = gtsam.Pose3(gtsam.Rot3.Ypr(*(rng.standard_normal(3) * (2.0, 0.2, 0.2))), np.zeros(3))
    up = gtsam.Unit3(pose.rotation().matrix().T @ (0.0, 0.0, 1.0))
    return pose.matrix(), np.asarray(up.retract(SIGMA * rng.standard_normal(2)).point3())


def test_gravity_holds_roll_and_pitch_as_well_as_it_says():
    """NEES of the direction of up over 300 poses of which else nothing is known, 2 degrees of freedom."""
    rng, nees = np.random.default_rng(0), []
    for _ in range(300):
        true, measured = leaning(rng)
        known, key, prior = GravityMeasurement(measured * 9.81, SIGMA), pose_symbol(0), gtsam.Pose3(true)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        graph.push_back(known.factor(key))
        graph.push_back(gtsam.PriorFactorPose3(key, prior, gtsam.noiseModel.Isotropic.Sigma(6, 10.0)))
        values.insert(key, prior.retract(0.05 * rng.standard_normal(6)))
        solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        turn = solved.atPose3(key).rotation().matrix()
        covariance = gtsam.Marginals(graph, solved).marginalCovariance(key)[:3, :3]
        error = gtsam.Rot3.Logmap(gtsam.Rot3(turn.T @ true[:3, :3]))
        axes = np.linalg.svd(turn[2:])[2][1:]  # across up: the heading stays free
        error, covariance = axes @ error, axes @ covariance @ axes.T
        nees.append(error @ np.linalg.solve(covariance, error))
    assert_mean_in_band(np.array(nees), 2)


def test_it_reaches_the_graph_and_an_estimator_that_resumes(tmp_path):
    true, up = leaning(np.random.default_rng(1))
    first = Keyframe(0, [], world_T_body_guess=true, pose_measurements=(GravityMeasurement(up, SIGMA),))
    with PlaneSlam.open(tmp_path / "session.db") as slam:
        slam.add_keyframe(first)
        estimate = slam.trajectory.poses[0]
    with Session.open(tmp_path / "session.db", read_only=True) as session:
        [known] = session.keyframe(0).pose_measurements
    np.testing.assert_array_equal(known.up_in_body, up)
    with PlaneSlam.open(tmp_path / "session.db", read_only=True) as again:
        np.testing.assert_array_equal(again.trajectory.poses[0], estimate)


@pytest.mark.parametrize(
    ("up_z", "sigma_rad", "says"),
    [(0.0, 0.1, "expected a direction"), (np.nan, 0.1, "finite"), (1.0, -0.1, "sigma_rad")],
)
def test_one_that_is_none_is_refused_and_leaves_no_trace(up_z, sigma_rad, says):
    slam, bad = PlaneSlam(), GravityMeasurement(np.array([0.0, 0.0, up_z]), sigma_rad)
    with pytest.raises(ValueError, match=says) as refused:
        slam.add_keyframe(replace(Keyframe(0, []), pose_measurements=(bad,)))
    assert str(refused.value).startswith("keyframe.pose_measurements[0]") and len(slam.keyframes) == 0
