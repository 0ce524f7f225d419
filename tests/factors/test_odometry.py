"""Odometry and the floor: what the covariance means, by drawing from it."""

import gtsam
import numpy as np
import pytest

from factors import odometry_factor, odometry_factor_2d, planar_motion_factor, pose_prior, relative_pose_factor
from tests.factors.factor_scenes import random_covariance, random_pose, values_of
from tests.statistics import assert_mean_in_band

X0, X1 = gtsam.symbol("x", 0), gtsam.symbol("x", 1)
RUNS = 1000


def draws():
    """True steps with large turns, and readings whose three numbers are off by what their covariance says."""
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        step = np.array([rng.normal(), rng.normal(), rng.uniform(-2.5, 2.5)])
        covariance = random_covariance(rng, np.array([0.01, 0.05, 0.01]))
        yield rng, step, step + rng.multivariate_normal(np.zeros(3), covariance), covariance


def test_planar_odometry_is_additive_in_the_axes_of_a():
    sample = []
    for rng, step, reading, covariance in draws():
        a = gtsam.Pose2(*rng.normal(size=3))
        values = values_of(x0=a, x1=a.compose(gtsam.Pose2(*step)))
        sample.append(2.0 * odometry_factor_2d(X0, X1, reading, covariance).error(values))
    assert_mean_in_band(sample, 3, 0.999)


def test_odometry_on_pose3_adds_the_stated_sigmas_out_of_the_plane():
    sigmas = (0.02, 0.01, 0.03)
    sample = []
    for rng, step, reading, covariance in draws():
        a = random_pose(rng)
        z, roll, pitch = rng.normal(size=3) * sigmas
        off = gtsam.Pose3(gtsam.Rot3.RzRyRx(roll, pitch, 0.0), np.array([0.0, 0.0, z]))
        b = a.compose(gtsam.Pose3(gtsam.Rot3.Yaw(step[2]), np.array([*step[:2], 0.0]))).compose(off)
        factor = odometry_factor(X0, X1, reading, covariance, out_of_plane_sigmas=sigmas)
        sample.append(2.0 * factor.error(values_of(x0=a, x1=b)))
    assert_mean_in_band(sample, 6, 0.999)


def test_spatial_odometry_and_pose_priors_in_sp_order():
    sample, prior = [], []
    for seed in range(RUNS):
        rng = np.random.default_rng(seed)
        covariance = random_covariance(rng, np.array([0.001, 0.02, 0.005, 0.003, 0.03, 0.01]))
        x, y, z, phi, theta, psi = rng.multivariate_normal(np.zeros(6), covariance)
        off = gtsam.Pose3(gtsam.Rot3.RzRyRx(psi, theta, phi), np.array([x, y, z]))
        a, step = random_pose(rng), random_pose(rng)
        values = values_of(x0=a, x1=a.compose(step).compose(off))
        sample.append(2.0 * relative_pose_factor(X0, X1, step.matrix(), covariance).error(values))
        prior.append(2.0 * pose_prior(X1, a.compose(step).matrix(), covariance).error(values))
    assert_mean_in_band(sample, 6, 0.999)
    assert_mean_in_band(prior, 6, 0.999)


@pytest.mark.parametrize("yaw", [0.0, 1.0, 3.1])
@pytest.mark.parametrize("where", [(0.0, 0.0), (500.0, -300.0)])
def test_the_floor_holds_height_and_tilt_and_nothing_else(yaw, where):
    floor = planar_motion_factor(X0, height=0.4, sigmas=(0.02, 0.01, 0.01))
    level = gtsam.Pose3(gtsam.Rot3.Yaw(yaw), np.array([*where, 0.4]))
    assert floor.error(values_of(x0=level)) < 1e-9
    for tangent, expected in (
        ([0.005, 0, 0, 0, 0, 0], 0.5 * (np.sin(0.005) / 0.01) ** 2),
        ([0, 0.005, 0, 0, 0, 0], 0.5 * (np.sin(0.005) / 0.01) ** 2),
        ([0, 0, 0.5, 0, 0, 0], 0.0),
        ([0, 0, 0, 2.0, 3.0, 0], 0.0),
        ([0, 0, 0, 0, 0, 0.03], 0.5 * 1.5**2),
    ):
        off = floor.error(values_of(x0=level.retract(np.array(tangent, dtype=float))))
        assert off == pytest.approx(expected, rel=1e-6, abs=1e-9)


@pytest.mark.parametrize("factor", [odometry_factor, odometry_factor_2d])
def test_odometry_takes_a_pose2_and_refuses_degrees(factor):
    covariance = np.diag([1e-4, 1e-4, 1e-6])
    numbers, pose = (factor(1, 2, delta, covariance) for delta in ((1.0, -2.0, 0.5), gtsam.Pose2(1.0, -2.0, 0.5)))
    assert numbers.equals(pose, 1e-12)
    assert factor(1, 2, (0.0, 0.0, -2.0 * np.pi), covariance).measured().equals(type(pose.measured())(), 1e-9)
    with pytest.raises(ValueError, match="delta: expected an angle of at most a full turn, in rad, got 90"):
        factor(1, 2, (1.0, 0.0, 90.0), covariance)
