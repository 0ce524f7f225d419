"""iSAM2: with `isam2_parameters` and `settle` as honest as a batch, far away too; outliers; covariances of its own."""

from functools import partial
from itertools import pairwise

import gtsam
import numpy as np
import pytest

import factors
from factors import isam2_parameters, isam_covariance, joint_covariance, plane_factor, plane_landmark, pose_prior
from spplanes import Plane
from tests.factors.factor_scenes import TIED_NORMALS, A, L, X, frame_of, graph_of, perturbed, values_of
from tests.spplanes.fitting.fit_scenes import error_of
from tests.statistics import mean_nees_band

N_POSES, RADIUS_M, SEEN_FROM_M = 25, 4.0, 8.5
WALLS = [
    frame_of(np.array(normal, dtype=float), np.array(origin, dtype=float), 0.0)
    for normal, origin in (
        ((0, 0, 1), (0, 4, 0)),
        ((0, 0, -1), (0, 4, 3)),
        ((0, 1, 0), (0, -3, 1.5)),
        ((0, -1, 0), (0, 11, 1.5)),
        ((-1, 0, 0), (7, 4, 1.5)),
        ((1, 0, 0), (-7, 4, 1.5)),
    )
]
#: (x, y, z, phi, theta, psi) of one step of odometry; (z, theta, psi) of one plane.
STEP_SIGMAS = np.array([0.05, 0.05, 0.02, 0.05, 0.02, 0.02])
PLANE_SIGMAS = np.array([0.001, 0.0006, 0.0006])
TO_POSE3 = np.array([5, 4, 3, 0, 1, 2])
x, plane_key = partial(gtsam.symbol, "x"), partial(gtsam.symbol, "l")


def drive() -> list[gtsam.Pose3]:
    """Once round a circle in a hall."""
    angles = 2.0 * np.pi * np.arange(N_POSES) / N_POSES
    places = np.column_stack((RADIUS_M * np.sin(angles), RADIUS_M * (1.0 - np.cos(angles)), np.ones(N_POSES)))
    return [gtsam.Pose3(gtsam.Rot3.Yaw(angle), place) for angle, place in zip(angles, places, strict=True)]


def sees(pose: gtsam.Pose3, j: int) -> bool:
    return j < 2 or bool(np.linalg.norm(pose.translation()[:2] - WALLS[j][:2, 3]) < SEEN_FROM_M)


def estimated(seed: int, parameters: gtsam.ISAM2Params | None, origin=(0.0, 0.0, 0.0)):
    """iSAM2 or None, the whole graph, its values and anchors, and the true poses, in a world about ``origin``."""
    rng = np.random.default_rng(seed)
    local = drive()
    truth = [gtsam.Pose3(gtsam.Rot3(), np.array(origin)).compose(pose) for pose in local]
    noise = STEP_SIGMAS * rng.normal(size=(N_POSES - 1, 6))
    steps = [a.between(b).retract(e[TO_POSE3]) for (a, b), e in zip(pairwise(local), noise, strict=True)]
    isam = None if parameters is None else gtsam.ISAM2(parameters)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    anchors: dict[int, int] = {}
    for i, pose in enumerate(local):
        new_factors, new_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        guess = truth[0]
        if i == 0:
            new_factors.push_back(pose_prior(x(0), truth[0], 1e-8 * np.eye(6)))
        else:
            before = values.atPose3(x(i - 1)) if isam is None else isam.calculateEstimatePose3(x(i - 1))
            guess = before.compose(steps[i - 1])
            new_factors.push_back(factors.relative_pose_factor(x(i - 1), x(i), steps[i - 1], np.diag(STEP_SIGMAS**2)))
        new_values.insert(x(i), guess)
        for j in (j for j in range(len(WALLS)) if sees(pose, j)):
            error = perturbed(np.eye(4), PLANE_SIGMAS * rng.normal(size=3))
            seen = Plane(pose.inverse().matrix() @ WALLS[j] @ np.linalg.inv(error), np.diag(PLANE_SIGMAS**2))
            if j not in anchors:
                anchors[j] = x(i)
                new_values.insert(plane_key(j), plane_landmark(seen))
            new_factors.push_back(plane_factor(seen, x(i), plane_key(j), anchor_key=anchors[j]))
        if isam is not None:
            isam.update(new_factors, new_values)
            if parameters.relinearizeSkip == 1:
                factors.settle(isam)
        graph.push_back(new_factors)
        values.insert(new_values)
    return isam, graph, values, anchors, truth


def scores(seed: int, parameters: gtsam.ISAM2Params | None) -> tuple[float, float]:
    """Mean NEES of two poses and of the planes; without parameters by Levenberg-Marquardt on the whole."""
    isam, graph, values, anchors, truth = estimated(seed, parameters)
    if isam is None:
        estimate = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        covariance = partial(joint_covariance, gtsam.Marginals(graph, estimate))
    else:
        estimate = isam.calculateEstimate()
        covariance = partial(isam_covariance, isam, estimate)
    poses, planes = [], []
    for i in (N_POSES // 2, N_POSES - 1):
        error = estimate.atPose3(x(i)).localCoordinates(truth[i])
        poses.append(error @ np.linalg.solve(covariance([x(i)]), error))
    for j, anchor in anchors.items():
        landmark, pose = estimate.atOrientedPlane3(plane_key(j)), estimate.atPose3(anchor)
        found = factors.world_plane_from_joint(
            landmark, pose, covariance([anchor, plane_key(j)]), centre=WALLS[j][:3, 3]
        )
        error = error_of(found.frame, WALLS[j])
        planes.append(error @ np.linalg.solve(found.covariance, error))
    return float(np.mean(poses)), float(np.mean(planes))


def test_isam2_on_planes_is_as_honest_as_a_batch_with_our_parameters_and_not_with_gtsams():
    batch, ours, stock = (
        np.array([scores(seed, parameters) for seed in range(8)])
        for parameters in (None, isam2_parameters(), gtsam.ISAM2Params())
    )
    np.testing.assert_allclose(ours, batch, rtol=0.02)
    low, high = mean_nees_band(2 * 8, 6)
    assert low < ours[:, 0].mean() < high
    assert stock[:, 0].mean() > high


def test_far_from_the_origin_the_answer_is_the_same():
    far_away = np.array([10_000.0, -4_000.0, 20.0])
    (near, *_, anchors, _), (far, *_) = (estimated(0, isam2_parameters(), at) for at in (np.zeros(3), far_away))
    here, there = near.calculateEstimate(), far.calculateEstimate()
    for i in range(N_POSES):
        a, b = here.atPose3(x(i)), there.atPose3(x(i))
        np.testing.assert_allclose(b.translation() - far_away, a.translation(), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(b.rotation().matrix(), a.rotation().matrix(), atol=1e-6)
        np.testing.assert_allclose(far.marginalCovariance(x(i)), near.marginalCovariance(x(i)), rtol=1e-4, atol=1e-10)
    for key in map(plane_key, anchors):
        a, b = here.atOrientedPlane3(key), there.atOrientedPlane3(key)
        np.testing.assert_allclose(b.planeCoefficients(), a.planeCoefficients(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("robust", ["huber", "cauchy", "geman-mcclure", "dcs", ("huber", 1.0)])
@pytest.mark.parametrize("form", ["anchored", "first"])
def test_robust_kernels_in_isam2(robust, form):
    """One wrong match of 0.5 m among ten right ones: pulled in by less than a tenth of what it does unrobust."""
    right, shifted = Plane(WALLS[3], np.diag([0.01, 0.01, 0.01]) ** 2), WALLS[3].copy()
    shifted[1, 3] += 0.5
    pulls = []
    for kernel in (None, robust):
        isam, other = gtsam.ISAM2(gtsam.ISAM2Params()), x(1) if form == "anchored" else x(0)
        priors = [pose_prior(key, np.eye(4), 1e-8 * np.eye(6)) for key in (x(0), x(1))]
        planes = [right] * 10 + [Plane(shifted, right.covariance)]
        seen = [plane_factor(plane, other, plane_key(0), anchor_key=x(0), robust=kernel) for plane in planes]
        isam.update(graph_of(*priors, *seen), values_of(x0=gtsam.Pose3(), x1=gtsam.Pose3(), l0=plane_landmark(right)))
        for _ in range(20):
            isam.update()
        distance = isam.calculateBestEstimate().atOrientedPlane3(plane_key(0)).planeCoefficients()[3]
        pulls.append(abs(distance + right.d))
    assert pulls[0] == pytest.approx(0.5 / 11, rel=0.05)
    assert pulls[1] < 0.25 * pulls[0]


def test_settling_stops_when_nothing_moves():
    isam = gtsam.ISAM2(isam2_parameters())
    prior = pose_prior(x(0), np.eye(4), np.eye(6))
    isam.update(graph_of(prior), values_of(x0=gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.ones(3))))
    assert 1 < factors.settle(isam) < 8
    assert factors.settle(isam) == 1
    assert isam.calculateEstimatePose3(x(0)).equals(gtsam.Pose3(), 1e-6)


def run(normal):
    """iSAM2, its graph and estimate: an anisotropic plane, linearised a little to the other side of the tie."""
    plane = Plane(frame_of(normal, 2.0 * normal, 0.3), np.diag([1e-6, 1e-7, 1e-4]))
    prior = pose_prior(A, np.eye(4), np.diag([1, 2, 3, 4, 5, 6]) * 1e-6)
    step = factors.relative_pose_factor(A, X, np.eye(4), np.diag([6, 5, 4, 3, 2, 1]) * 1e-6)
    graph = graph_of(prior, step, plane_factor(plane, X, L, anchor_key=A))
    turned = plane.frame[:3, :3] @ gtsam.Rot3.RzRyRx(2e-3, -3e-3, 0.0).matrix()
    landmark = gtsam.OrientedPlane3(gtsam.Unit3(turned[:, 2]), -plane.d)
    values, parameters = values_of(a0=gtsam.Pose3(), x0=gtsam.Pose3(), l0=landmark), gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.1)
    isam = gtsam.ISAM2(parameters)
    isam.update(graph, values)
    return isam, graph, isam.calculateEstimate()


@pytest.mark.parametrize("keys", [(A, L), (L, X, A), (L,)])
def test_isam_covariance_is_that_of_a_batch_at_the_estimate(keys):
    turned = 0
    for normal in TIED_NORMALS:
        isam, graph, estimate = run(normal)
        marginals = gtsam.Marginals(graph, estimate)
        batch = joint_covariance(marginals, list(keys))
        scale = np.sqrt(np.outer(np.diag(batch), np.diag(batch)))
        np.testing.assert_allclose(isam_covariance(isam, estimate, keys) / scale, batch / scale, atol=0.05)
        turned += np.abs(isam.jointMarginalCovariance(list(keys)).fullMatrix() / scale - batch / scale).max() > 0.5
    assert turned >= 4  # or the bases never jumped, and the test says nothing
