"""Derivatives of every factor against central differences, at random linearisation points."""

import gtsam
import numpy as np
import pytest

from factors import (
    line_factor,
    line_factor_2d,
    odometry_factor,
    odometry_factor_2d,
    planar_motion_factor,
    plane_factor,
    plane_prior,
)
from tests.factors.factor_scenes import (
    TIED_NORMALS,
    A,
    L,
    X,
    assert_jacobian,
    random_line,
    random_normals,
    random_plane,
    random_pose,
    values_of,
)

SEEDS = range(200)


def scene(rng: np.random.Generator) -> gtsam.Values:
    normal = TIED_NORMALS[rng.integers(len(TIED_NORMALS))] if rng.random() < 0.3 else random_normals(rng, 1)[0]
    landmark = gtsam.OrientedPlane3(np.array([*normal, rng.normal() * 3.0]))
    return values_of(x0=random_pose(rng), x1=random_pose(rng), a0=random_pose(rng), l0=landmark)


@pytest.mark.parametrize("anchor", [A, None, X], ids=["anchored", "world", "own anchor"])
def test_plane_factor(anchor):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        assert_jacobian(plane_factor(random_plane(rng), X, L, anchor_key=anchor), scene(rng))


@pytest.mark.parametrize("anchor", [A, None, X], ids=["anchored", "world", "own anchor"])
def test_line_factor(anchor):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        mount = random_pose(rng).matrix()
        assert_jacobian(line_factor(random_line(rng), mount, X, L, anchor_key=anchor), scene(rng))


@pytest.mark.parametrize("anchor", [A, None, X], ids=["anchored", "world", "own anchor"])
def test_line_factor_on_pose2(anchor):
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        values = values_of(l0=scene(rng).atOrientedPlane3(L))
        for key in (X, A):
            values.insert(key, gtsam.Pose2(*rng.normal(size=3)))
        mount = random_pose(rng).matrix()
        assert_jacobian(line_factor_2d(random_line(rng), mount, X, L, anchor_key=anchor), values)


def test_plane_prior():
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        assert_jacobian(plane_prior(random_plane(rng), L), scene(rng))


def test_odometry_and_planar_motion():
    other = gtsam.symbol("x", 1)
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        values, delta = scene(rng), rng.normal(size=3)
        near = values.atPose3(other).compose(gtsam.Pose3(gtsam.Rot3.Yaw(delta[2]), np.array([*delta[:2], 0.0])))
        values.update(X, near.retract(0.1 * rng.normal(size=6)))
        assert_jacobian(odometry_factor(other, X, delta, np.diag([0.1, 0.2, 0.3]) ** 2), values)
        motion = planar_motion_factor(X, height=0.3)
        for i in range(motion.size()):
            assert_jacobian(motion.at(i), values)
        flat = values_of(x0=gtsam.Pose2(*rng.normal(size=3)), x1=gtsam.Pose2(*rng.normal(size=3)))
        assert_jacobian(odometry_factor_2d(other, X, delta, np.diag([0.1, 0.2, 0.3]) ** 2), flat)
