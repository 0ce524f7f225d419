"""Landmarks: each lives in one frame; their covariance against what happens in repeated experiments."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from shapely import box

import factors
from spplanes import Plane
from tests.factors.factor_scenes import (
    A,
    L,
    X,
    frame_of,
    graph_of,
    make_line,
    perturbed,
    random_covariance,
    random_plane,
    random_pose,
    values_of,
)
from tests.spplanes.fitting.fit_scenes import error_of
from tests.statistics import assert_mean_in_band

RUNS = 200
TILTS = np.array([0.005, np.radians(0.1), np.radians(0.8)])


def nees(plane: Plane, true_frame: np.ndarray) -> float:
    """p^T C^-1 p of the SP perturbation that takes the estimate to the truth."""
    p = error_of(plane.frame, true_frame)
    return float(p @ np.linalg.solve(plane.covariance, p))


def experiment(seed: int, *, anchored: bool):
    """Two uncertain poses see one plane, the graph is solved: NEES of the plane read off in three frames."""
    scene, rng = np.random.default_rng(100), np.random.default_rng([1, seed])
    true_a, true_x = random_pose(scene), random_pose(scene)
    frame = frame_of(np.array([0.0, 0.0, 1.0]), np.array([1.0, 2.0, -1.0]), 0.4)
    prior_covariance = random_covariance(scene, np.full(6, 0.02))
    step_covariance = random_covariance(scene, np.full(6, 0.03))

    def drawn(pose: gtsam.Pose3, covariance: np.ndarray) -> np.ndarray:
        p = rng.multivariate_normal(np.zeros(6), covariance)
        return pose.compose(gtsam.Pose3(gtsam.Rot3.RzRyRx(p[5], p[4], p[3]), p[:3]).inverse()).matrix()

    def seen(pose: gtsam.Pose3) -> Plane:
        covariance = random_covariance(rng, TILTS)
        p = rng.multivariate_normal(np.zeros(3), covariance)
        return Plane(pose.inverse().matrix() @ frame @ np.linalg.inv(perturbed(np.eye(4), p)), covariance)

    at_a, at_x, key = seen(true_a), seen(true_x), A if anchored else None
    prior, step = drawn(true_a, prior_covariance), drawn(true_a.between(true_x), step_covariance)
    graph = factors.plane_factors([at_a, at_x], [A, X], [L, L], [A, A] if anchored else None)
    graph.push_back(factors.pose_prior(A, prior, prior_covariance))
    graph.push_back(factors.relative_pose_factor(A, X, step, step_covariance))
    landmark = factors.plane_landmark(at_a) if anchored else factors.plane_landmark(at_a, prior)
    values = values_of(a0=gtsam.Pose3(prior), x0=gtsam.Pose3(prior @ step), l0=landmark)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    marginals = gtsam.Marginals(graph, result)
    in_world = factors.world_plane(result, marginals, L, anchor_key=key, centre=frame[:3, 3], n_points=7)
    assert in_world.n_points == 7
    pairs = [(in_world, frame)]
    for pose, pose_key in ((true_x, X), (true_a, A)):
        local = pose.inverse().matrix() @ frame
        found = factors.seen_plane(result, marginals, L, pose_key, anchor_key=key, centre=local[:3, 3])
        pairs.append((found, local))
    return [nees(plane, truth) for plane, truth in pairs]


@pytest.mark.parametrize("anchored", [True, False])
def test_covariances_out_of_a_solution_are_honest(anchored):
    """World, observer's frame and anchor's frame: NEES of 3 in each."""
    for sample in np.transpose([experiment(seed, anchored=anchored) for seed in range(RUNS)]):
        assert_mean_in_band(sample, 3, 0.999)


def test_change_of_anchor_moves_nothing_in_the_world():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        plane, pose, old, new = random_plane(rng), random_pose(rng), random_pose(rng), random_pose(rng)
        landmark = factors.plane_landmark(plane).transform(pose.between(old))
        moved = factors.change_anchor(landmark, old, new.matrix())
        back = moved.transform(new.between(pose))
        np.testing.assert_allclose(
            back.planeCoefficients(), factors.plane_landmark(plane).planeCoefficients(), atol=1e-12
        )


def test_a_landmark_of_a_planar_graph_is_that_of_the_same_graph_in_space():
    """All that a Pose2 cannot do a Pose3 is kept from by a micrometre and a microradian."""
    found, rng = [], np.random.default_rng(4)
    line, x, a = make_line(0.2, 3.0, np.diag([1e-6, 1e-4])), *(gtsam.Pose2(*rng.normal(size=3)) for _ in range(2))
    for kind, free, build in (
        (gtsam.Pose2, slice(3), factors.line_factor_2d),
        (gtsam.Pose3, [3, 4, 2], factors.line_factor),
    ):
        sigmas = np.full(3 if kind is gtsam.Pose2 else 6, 1e-6)
        sigmas[free] = 0.1, 0.2, 0.03
        noise, values = gtsam.noiseModel.Diagonal.Sigmas(sigmas), values_of(x0=kind(x), a0=kind(a))
        prior = gtsam.PriorFactorPose2 if kind is gtsam.Pose2 else gtsam.PriorFactorPose3
        seen = factors.plane_landmark(factors.LineObservation(line, np.eye(4)).full_plane(0.1), gtsam.Pose3(x))
        values.insert(L, seen.transform(gtsam.Pose3(a)))
        priors = prior(X, kind(x), noise), prior(A, kind(a), noise), factors.upright_prior(L, 0.01, anchor_key=A)
        graph = graph_of(*priors, build(line, np.eye(4), X, L, anchor_key=A))
        marginals = gtsam.Marginals(graph, values)
        in_world = factors.world_plane(values, marginals, L, anchor_key=A)
        found.append((in_world, factors.seen_plane(values, marginals, L, X, anchor_key=A)))
    for flat, spatial in zip(*found, strict=True):
        np.testing.assert_allclose(flat.frame, spatial.frame, atol=1e-12)
        np.testing.assert_allclose(flat.covariance, spatial.covariance, rtol=1e-4, atol=1e-9)


def test_facing_turns_the_plane_and_its_covariance():
    """The same half-space from behind: the error of a reversed landmark against the reversed plane is the same."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        plane = replace(random_plane(rng), n_points=5, outline=box(0.0, 0.0, 2.0, 1.0))
        behind = plane.centre - 2.0 * plane.normal
        assert factors.facing(plane, plane.centre + plane.normal) is plane
        turned = factors.facing(plane, behind)
        np.testing.assert_allclose(turned.normal, -plane.normal)
        assert turned.d == pytest.approx(-plane.d)
        assert turned.n_points == 5
        assert all(np.linalg.norm(corners(plane) - corner, axis=1).min() < 1e-12 for corner in corners(turned))
        landmark = factors.plane_landmark(plane).retract(1e-3 * rng.normal(size=3))
        reverse = gtsam.OrientedPlane3(-landmark.planeCoefficients())
        before = factors.plane_prior(plane, L).error(values_of(l0=landmark))
        assert factors.plane_prior(turned, L).error(values_of(l0=reverse)) == pytest.approx(before, rel=1e-9)


def corners(plane: Plane) -> np.ndarray:
    return np.array([(plane.frame @ [x, y, 0.0, 1.0])[:3] for x, y in plane.outline.exterior.coords])


def test_centre_is_dropped_onto_the_plane():
    plane = factors.landmark_to_plane(gtsam.OrientedPlane3(0.0, 0.0, 1.0, -2.0), np.eye(3), centre=(3.0, 4.0, 9.0))
    np.testing.assert_allclose(plane.centre, [3.0, 4.0, 2.0])
    without = factors.landmark_to_plane(gtsam.OrientedPlane3(0.0, 0.0, 1.0, -2.0), np.eye(3))
    np.testing.assert_allclose(without.centre, [0, 0, 2])


PLANE = random_plane(np.random.default_rng(0))
OTHER = gtsam.symbol("l", 12)


def test_anchors_of_a_graph():
    graph = graph_of(
        factors.plane_factor(PLANE, X, L, anchor_key=A),
        factors.plane_factor(PLANE, A, L, anchor_key=A),
        factors.upright_prior(L, 0.1, anchor_key=A),
        factors.plane_factor(PLANE, X, OTHER),
        factors.plane_prior(PLANE, OTHER),
        factors.parallel_factor(L, OTHER, 0.1, anchor_a=A),
    )
    graph.resize(8)
    assert factors.landmark_anchors(graph) == {L: A, OTHER: None}


@pytest.mark.parametrize(
    ("forgetful", "told"),
    [
        (factors.direction_prior(L, (0.0, 0.0, 1.0), 0.1), "the world"),
        (factors.direction_prior(L, (0.0, 0.0, 1.0), 0.1, robust="huber"), "the world"),
        (factors.upright_prior(L, 0.1), "the world"),
        (factors.parallel_factor(L, OTHER, 0.1, anchor_a=X), "x0"),
        (factors.perpendicular_factor(OTHER, L, 0.1), "the world"),
        (factors.distance_factor(L, OTHER, 1.0, 0.1, anchor_b=A), "the world"),
    ],
)
def test_what_is_known_of_a_plane_without_its_anchor_is_refused(forgetful, told):
    with pytest.raises(ValueError, match=f"expected one anchor .* got two for l0: a0 and {told}"):
        factors.landmark_anchors(graph_of(factors.plane_factor(PLANE, X, L, anchor_key=A), forgetful))


@pytest.mark.parametrize(("anchor", "told"), [(None, "the world"), (X, "x0")])
def test_two_frames_for_one_landmark_are_refused(anchor, told):
    other = factors.plane_factor(PLANE, gtsam.symbol("x", 7), OTHER, anchor_key=anchor)
    graph = graph_of(factors.plane_factor(PLANE, X, OTHER, anchor_key=A), other)
    with pytest.raises(ValueError, match=f"graph: expected one anchor .* got two for l12: a0 and {told}"):
        factors.landmark_anchors(graph)
    with pytest.raises(ValueError, match=f"anchor_keys: expected one anchor .* got two for l12: a0 and {told}"):
        factors.plane_factors([PLANE, PLANE], [X, gtsam.symbol("x", 7)], [OTHER, OTHER], [A, anchor])
