"""The condensed solution against one batch of all factors, by GTSAM; what ties mean, by central differences."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import world_plane
from slam.joining import FinishedMission, JoinedComponent
from slam.joining.condensation import condense
from slam.joining.join import classes_of, shared_by
from slam.joining.solution import JointSolution, Place, Tie, TiedKeys, joint_key, tie_factor, tied_difference
from slam.output.joined_folder import flat_graph
from tests.factors.factor_scenes import assert_jacobian
from tests.slam.joining.missions import first, room_T_second, second


def without_floor(one: FinishedMission) -> FinishedMission:
    """A mission that nothing holds to its own frame: what would hold it there has no place in one graph of all."""
    kept = gtsam.NonlinearFactorGraph()
    for index in range(one.graph.factors.size()):
        factor = one.graph.factors.at(index)
        if factor.size() > 1 or chr(factor.keys()[0] >> 56) != "x" or isinstance(factor, gtsam.PriorFactorPose3):
            kept.push_back(factor)
    return replace(one, graph=replace(one.graph, factors=kept))


def solved(seed: int) -> JoinedComponent:
    members = (first(seed), without_floor(second(seed)))
    room_T = room_T_second(seed)[:3, :3]
    ties = [
        Tie(Place(0, mine.id), Place(1, other.id))
        for mine in members[0].mission.planes
        for other in members[1].mission.planes
        if mine.plane.normal @ room_T @ other.plane.normal > 0.9
    ]
    starts = {0: np.eye(4), 1: room_T_second(seed)}
    graphs = {number: one.graph for number, one in enumerate(members)}
    loose = (1e2, 1e1)  # one graph of all has no bases, and no floor that they would be on
    solution = JointSolution(graphs, starts, shared_by(2, ties), tuple(ties), floor_sigmas=loose)
    solution.solve(1e-6)
    return JoinedComponent(members, solution, classes_of(ties, [one.mission for one in members]))


def batch(component: JoinedComponent) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = flat_graph(component)
    rng, steps = np.random.default_rng(0), gtsam.VectorValues()
    for key in values.keys():  # noqa: SIM118 - not a mapping
        steps.insert(key, 1e-3 * rng.standard_normal(6 if chr(key >> 56) == "x" else 3))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setLinearSolverType("MULTIFRONTAL_QR")
    parameters.setRelativeErrorTol(1e-15)
    parameters.setAbsoluteErrorTol(1e-15)
    parameters.setMaxIterations(100)
    return graph, gtsam.LevenbergMarquardtOptimizer(graph, values.retract(steps), parameters).optimize()


def test_estimates_are_those_of_one_batch_of_all_factors():
    """Poses and planes, to 1e-6 m and rad; the batch starts 1e-3 off."""
    for seed in range(3):
        component = solved(seed)
        graph, values = batch(component)
        assert graph.size() == sum(one.graph.factors.size() for one in component.missions) - 1  # the second's start
        for number, one in enumerate(component.missions):
            for key in one.graph.carriers:
                apart = component.solution.pose(number, key).between(values.atPose3(joint_key(number, key)))
                np.testing.assert_allclose(gtsam.Pose3.Logmap(apart), np.zeros(6), atol=1e-6)
        for landmark in range(6):
            keys = component.solution.keys(Place(0, landmark))
            mine = component.solution.values[0].atOrientedPlane3(component.missions[0].graph.planes[landmark][1])
            np.testing.assert_allclose(values.atOrientedPlane3(keys.plane).errorVector(mine), np.zeros(3), atol=1e-6)


def test_covariances_are_those_of_one_batch_of_all_factors():
    """Of planes in the common frame and of the second mission's last pose, to 1e-4 of themselves."""
    component = solved(0)
    graph, values = batch(component)
    marginals, found = gtsam.Marginals(graph, values), []
    for one, (place, _) in zip(component.planes, component.classes, strict=True):
        keys = component.solution.keys(place)
        other = world_plane(values, marginals, keys.plane, anchor_key=keys.anchor, shape_of=one.plane)
        found.append((one.plane.covariance, other.transform(np.eye(4)).covariance))
    last = component.missions[1].graph.carriers[-1]
    found.append((component.pose_covariance(1, 14), marginals.marginalCovariance(joint_key(1, last))))
    for ours, expected in found:
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(ours / scale, expected / scale, atol=1e-4)


def test_a_condensed_mission_is_the_marginal_of_the_whole():
    """The information on what is kept, and back-substitution gives the step of the whole, to 1e-9 of themselves."""
    graph, shaken = first(0).graph, gtsam.VectorValues()
    for key in graph.values.keys():  # noqa: SIM118 - not a mapping
        shaken.insert(key, np.full(6 if chr(key >> 56) == "x" else 3, 1e-3))
    values = graph.values.retract(shaken)
    keep = sorted({key for pair in graph.planes.values() for key in pair})
    whole = graph.factors.linearize(values)
    condensed, every = condense(whole, keep), whole.optimize()
    marginals, root = gtsam.Marginals(whole, every), condensed.shared.jacobian()[0]
    expected = marginals.jointMarginalInformation(list(condensed.shared.keys())).fullMatrix()
    np.testing.assert_allclose(root.T @ root, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    shared = gtsam.VectorValues()
    for key in keep:
        shared.insert(key, every.at(key))
    steps, _ = condensed.back_substituted(shared)
    for key in graph.values.keys():  # noqa: SIM118 - not a mapping
        np.testing.assert_allclose(steps.at(key), every.at(key), atol=1e-9)


FIRST, SECOND = TiedKeys(1, 2, 3), TiedKeys(4, 5, 6)


def values_of(seed: int, off: np.ndarray) -> gtsam.Values:
    """Two missions that see one plane, which the second has a little off."""
    rng, values = np.random.default_rng(seed), gtsam.Values()
    poses = [gtsam.Pose3.Expmap(rng.normal(size=6) * (0.6, 0.6, 0.6, 3.0, 3.0, 3.0)) for _ in range(4)]
    plane = gtsam.OrientedPlane3(np.append(rng.normal(size=3), rng.normal()))
    for side, (base, anchor) in zip((FIRST, SECOND), (poses[:2], poses[2:]), strict=True):
        values.insert(side.base, base)
        values.insert(side.anchor, anchor)
        values.insert(side.plane, plane.transform(base.compose(anchor)))
    values.update(SECOND.plane, values.atOrientedPlane3(SECOND.plane).retract(off))
    return values


@pytest.mark.parametrize("seed", range(5))
def test_the_distance_is_that_of_the_planes(seed: int):
    difference, _ = tied_difference(values_of(seed, np.array([0.0, 0.0, 0.25])), FIRST, SECOND)
    np.testing.assert_allclose(difference, [0.0, 0.0, 0.25], atol=1e-12)  # Hesse: d of OrientedPlane3 is the other sign


@pytest.mark.parametrize("seed", range(5))
def test_derivatives_of_a_tie(seed: int):
    """By central differences, where the planes are one: there the basis that the tilt is told in does not matter."""
    assert_jacobian(tie_factor(FIRST, SECOND), values_of(seed, np.zeros(3)))
