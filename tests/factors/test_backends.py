"""In the optimisers: far from the origin, incrementally, with outliers."""

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from factors import (
    plane_factor,
    plane_landmark,
    pose_prior,
    relative_pose_factor,
)
from spplanes import Plane
from tests.factors.factor_scenes import frame_of, perturbed, random_covariance

WALLS = [
    frame_of(np.array(n, dtype=float), np.array(o, dtype=float), 0.0)
    for n, o in (
        ((0, 0, 1), (4, 1, 0)),
        ((0, 0, -1), (4, 1, 2.6)),
        ((0, 1, 0), (4, -2, 1.2)),
        ((0, -1, 0), (4, 3, 1.2)),
        ((-1, 0, 0), (12, 1, 1.2)),
        ((1, 0, 0), (-3, 1, 1.2)),
    )
]
N_POSES = 15


def pose_key(i: int) -> int:
    return gtsam.symbol("x", i)


def plane_key(j: int) -> int:
    return gtsam.symbol("l", j)


def corridor(origin: np.ndarray):
    """True poses along a corridor at ``origin``, and noisy planes seen from each, in the poses' frames."""
    rng = np.random.default_rng(8)
    offset = gtsam.Pose3(gtsam.Rot3(), origin)
    truth = [
        gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02 * np.sin(i), 0.03 * np.cos(i), 0.2 * i), np.array([0.5 * i, 0.3, 1.0]))
        for i in range(N_POSES)
    ]
    seen = []
    for pose in truth:
        planes = []
        for frame in WALLS:
            covariance = random_covariance(rng, np.array([0.004, 0.002, 0.006]))
            p = rng.multivariate_normal(np.zeros(3), covariance)
            planes.append(Plane(pose.inverse().matrix() @ frame @ np.linalg.inv(perturbed(np.eye(4), p)), covariance))
        seen.append(planes)
    steps = [a.between(b).retract(0.02 * rng.normal(size=6)) for a, b in pairwise(truth)]
    return [offset.compose(pose) for pose in truth], seen, steps


def run_isam(origin: np.ndarray) -> tuple[gtsam.Values, gtsam.ISAM2]:
    """Landmarks come up one after the other: pose i first sees plane j where i = 2 j."""
    truth, seen, steps = corridor(origin)
    isam = gtsam.ISAM2(gtsam.ISAM2Params())
    guess = truth[0]
    for i in range(N_POSES):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if i == 0:
            graph.push_back(pose_prior(pose_key(0), truth[0].matrix(), 1e-6 * np.eye(6)))
        else:
            guess = isam.calculateEstimatePose3(pose_key(i - 1)).compose(steps[i - 1])
            graph.push_back(relative_pose_factor(pose_key(i - 1), pose_key(i), steps[i - 1].matrix(), 4e-4 * np.eye(6)))
        values.insert(pose_key(i), guess)
        for j in range(len(WALLS)):
            if i >= 2 * j:
                graph.push_back(plane_factor(seen[i][j], pose_key(i), plane_key(j), anchor_key=pose_key(2 * j)))
                if i == 2 * j:
                    values.insert(plane_key(j), plane_landmark(seen[i][j]))
        isam.update(graph, values)
        isam.update()
    for _ in range(5):
        isam.update()
    return isam.calculateBestEstimate(), isam


FAR = np.array([10_000.0, -4_000.0, 20.0])


def test_isam2_far_from_the_origin_gives_the_same_answer():
    near, near_isam = run_isam(np.zeros(3))
    far, far_isam = run_isam(FAR)
    for i in range(N_POSES):
        a, b = near.atPose3(pose_key(i)), far.atPose3(pose_key(i))
        np.testing.assert_allclose(b.translation() - FAR, a.translation(), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(b.rotation().matrix(), a.rotation().matrix(), atol=1e-6)
        there = far_isam.marginalCovariance(pose_key(i))
        np.testing.assert_allclose(there, near_isam.marginalCovariance(pose_key(i)), rtol=1e-4, atol=1e-10)
    for j in range(len(WALLS)):
        a, b = near.atOrientedPlane3(plane_key(j)), far.atOrientedPlane3(plane_key(j))
        np.testing.assert_allclose(b.planeCoefficients(), a.planeCoefficients(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("robust", ["huber", "cauchy", "geman-mcclure", "dcs", ("huber", 1.0)])
@pytest.mark.parametrize("form", ["anchored", "first"])
def test_robust_kernels_in_isam2(robust, form):
    """One wrong match of 0.5 m among ten right ones: pulled in by less than a tenth of what it does unrobust."""
    pulls = {}
    for kernel in (None, robust):
        isam = gtsam.ISAM2(gtsam.ISAM2Params())
        right = Plane(WALLS[2], np.diag([0.01, 0.01, 0.01]) ** 2)
        shifted = WALLS[2].copy()
        shifted[1, 3] += 0.5
        wrong = Plane(shifted, right.covariance)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        keys = {"anchor_key": pose_key(0)}
        other = pose_key(1) if form == "anchored" else pose_key(0)
        for key in (pose_key(0), pose_key(1)):
            graph.push_back(pose_prior(key, np.eye(4), 1e-8 * np.eye(6)))
            values.insert(key, gtsam.Pose3())
        for plane in [right] * 10 + [wrong]:
            graph.push_back(plane_factor(plane, other, plane_key(0), robust=kernel, **keys))
        values.insert(plane_key(0), plane_landmark(right))
        isam.update(graph, values)
        for _ in range(20):
            isam.update()
        distance = isam.calculateBestEstimate().atOrientedPlane3(plane_key(0)).planeCoefficients()[3]
        pulls[kernel is None] = abs(distance + right.d)
    assert pulls[True] == pytest.approx(0.5 / 11, rel=0.05)
    assert pulls[False] < 0.25 * pulls[True]
