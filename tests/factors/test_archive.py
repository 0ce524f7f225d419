"""Graphs and factors survive being written, renamed and copied."""

import copy
import json
import pickle

import gtsam
import numpy as np
import pytest

import factors
from factors._check import held
from factors._custom import describe
from factors.archive import ArchiveError, dumps, loads, rekeyed
from tests.factors.factor_scenes import graph_of, random_line, random_plane, random_pose, values_of

X0, X1, X2, P0 = (gtsam.symbol(c, i) for c, i in (("x", 0), ("x", 1), ("x", 2), ("p", 0)))
L0, L1, L2 = (gtsam.symbol("l", i) for i in range(3))


def everything() -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    rng = np.random.default_rng(0)
    plane, line, mount = random_plane(rng), random_line(rng), random_pose(rng).matrix()
    graph, near = gtsam.NonlinearFactorGraph(), factors.plane_landmark(plane)
    for robust in (None, "huber", "cauchy", ("geman-mcclure", 3.0), "dcs"):
        for factor in (
            factors.plane_factor(plane, X0, L0, robust=robust),
            factors.plane_factor(plane, X1, L0, anchor_key=X0, robust=robust),
            factors.plane_factor(plane, X0, L0, anchor_key=X0, robust=robust),
            factors.plane_prior(plane, L1, robust=robust),
            factors.line_factor(line, mount, X0, L0, robust=robust),
            factors.line_factor(line, mount, X1, L0, anchor_key=X0, robust=robust),
            factors.line_factor(line, mount, X1, L0, anchor_key=X0, expected=near, robust=robust),
            factors.line_factor_2d(line, mount, P0, L0, robust=robust),
            factors.odometry_factor(X0, X1, (1.0, 0.1, 0.2), np.diag([0.1, 0.2, 0.1]), robust=robust),
            factors.odometry_factor_2d(P0, P0 + 1, (1.0, 0.1, 0.2), np.diag([0.1, 0.2, 0.1]), robust=robust),
            factors.planar_motion_factor(X0, robust=robust),
            factors.pose_prior(X0, mount, np.eye(6), robust=robust),
            factors.relative_pose_factor(X0, X1, mount, np.eye(6), robust=robust),
            factors.constant_velocity_factor((X0, X2, X1), np.eye(6), kept=[1, 1, 1, 0.5, 0.6, 0.7], robust=robust),
            factors.direction_prior(L0, (0.1, 0.2, 1.0), 0.01, robust=robust),
            factors.direction_prior(L0, (0.0, 0.0, 1.0), 0.01, anchor_key=X0, robust=robust),
            factors.upright_prior(L0, 0.01, anchor_key=X0, robust=robust),
            factors.parallel_factor(L0, L1, 0.01, anchor_a=X0, robust=robust),
            factors.perpendicular_factor(L0, L1, 0.01, robust=robust),
            factors.distance_factor(L0, L1, 2.5, 0.01, anchor_a=X0, anchor_b=X1, robust=robust),
            *(factors.map_prior([plane] * n, (L1, L0, L2)[:n], np.eye(3 * n), robust=robust) for n in (1, 2, 3)),
        ):
            graph.push_back(factor)
    values = values_of(**{f"x{i}": random_pose(rng) for i in range(3)})
    for i in range(2):
        values.insert(P0 + i, gtsam.Pose2(*rng.normal(size=3)))
    for key in (L0, L1, L2):
        values.insert(key, gtsam.OrientedPlane3(np.array([*random_plane(rng).normal, rng.normal()])))
    return graph, values


def test_every_factor_survives():
    graph, values = everything()
    graph.remove(3)
    back, back_values = loads(dumps(graph, values))
    assert back.size() == graph.size()
    assert not back.exists(3)
    assert back_values.keys() == values.keys()
    for i in range(graph.size()):
        if graph.exists(i):
            assert type(back.at(i)) is type(graph.at(i))
            assert list(back.at(i).keys()) == list(graph.at(i).keys())
            assert back.at(i).error(back_values) == pytest.approx(graph.at(i).error(values), rel=1e-12), i
            here, there = graph.at(i).linearize(values).jacobian(), back.at(i).linearize(back_values).jacobian()
            np.testing.assert_allclose(there[0], here[0], atol=1e-9)


def test_foreign_custom_factors_are_refused_by_name():
    noise = gtsam.noiseModel.Unit.Create(1)
    foreign = gtsam.CustomFactor(noise, [X0], lambda factor, values, jacobians: np.zeros(1))
    with pytest.raises(ArchiveError, match=r"factor 0: expected .*, got a foreign CustomFactor"):
        dumps(graph_of(foreign))
    with pytest.raises(TypeError, match="cannot pickle 'CustomFactor' object: factor 0: expected a factor that can be"):
        copy.deepcopy(foreign)


def test_a_factor_evaluated_while_another_is_asked_what_it_is_keeps_its_error():
    """As in another thread: what is inside is no matter of when it is asked."""
    graph, values = everything()
    ours, errors = graph.at(0), []

    def error(*_: object) -> np.ndarray:
        errors.append(ours.error(values))
        return np.zeros(1)

    assert describe(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [X0], error)) is None
    assert errors == [ours.error(values)]


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "other"}'])
def test_other_texts_are_refused(text):
    with pytest.raises(ArchiveError, match="text: expected"):
        loads(text)


@pytest.mark.parametrize("change", ["factors", "values", "keys", "data", "noise"])
def test_documents_without_all_of_a_graph_are_refused(change):
    document = json.loads(dumps(*everything()))
    for part in (document, *(next(iter(factor.values())) for factor in document["factors"])):
        if isinstance(part, dict):
            part.pop(change, None)
    with pytest.raises(ArchiveError, match="text: expected all of a graph, got a part of one or other"):
        loads(json.dumps(document))


def test_values_that_gtsam_cannot_archive_are_named():
    graph, values = everything()
    values.insert(gtsam.symbol("b", 3), 2.5)
    with pytest.raises(ArchiveError, match=r"values: GTSAM cannot archive b3 \(unregistered class"):
        dumps(graph, values)


def test_every_factor_over_other_variables_has_the_same_error():
    """All that a graph may hold, and a landmark that becomes another one living elsewhere."""
    graph, values = everything()
    names = {X0: gtsam.symbol("x", 70), X1: gtsam.symbol("x", 71), L1: gtsam.symbol("l", 71), P0: gtsam.symbol("p", 70)}
    moved = gtsam.Values(values)
    for old, new in names.items():
        found = (held(read, old) for read in (values.atPose3, values.atPose2, values.atOrientedPlane3))
        moved.insert(new, next(one for one in found if one is not None))
        moved.erase(old)
    for index in range(graph.size()):
        factor = graph.at(index)
        again = rekeyed(factor, names)
        assert [names.get(key, key) for key in factor.keys()] == list(again.keys())  # noqa: SIM118
        np.testing.assert_allclose(again.error(moved), factor.error(values), rtol=1e-9, atol=1e-12)


def test_a_landmark_with_a_new_home_is_the_same_plane_seen():
    """Seen from the pose it lived at, from another one, and as a line: its error is that of the plane at home."""
    rng = np.random.default_rng(1)
    plane, line = random_plane(rng), random_line(rng)
    poses = {name: random_pose(rng) for name in ("x0", "x1", "x9")}
    home, anchor = gtsam.symbol("l", 9), gtsam.symbol("x", 9)
    landmark = gtsam.OrientedPlane3(np.array([0.3, -0.5, 0.8, 1.5]))
    there = landmark.transform(poses["x0"].inverse()).transform(poses["x9"])
    old, new = values_of(**poses, l0=landmark), values_of(**poses, l9=there)
    for factor in (
        factors.plane_factor(plane, X0, L0, anchor_key=X0),
        factors.plane_factor(plane, X1, L0, anchor_key=X0),
        factors.line_factor(line, np.eye(4), X1, L0, anchor_key=X0),
    ):
        again = rekeyed(factor, {}, {L0: (home, anchor)})
        assert set(again.keys()) <= {X0, X1, home, anchor}
        np.testing.assert_allclose(again.error(new), factor.error(old), rtol=1e-9)
    for several in (factors.parallel_factor(L0, L1, 0.01), factors.map_prior([plane] * 3, [L1, L2, L0], np.eye(9))):
        with pytest.raises(ArchiveError, match="single plane"):
            rekeyed(several, {}, {L0: (home, anchor)})
    with pytest.raises(ArchiveError, match="comes home"):
        rekeyed(factors.plane_factor(plane, X1, L0, anchor_key=X0), {}, {L0: (home, X1)})


@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])  # noqa: S301
def test_a_copied_factor_has_the_same_error(how):
    """GTSAM's own copy of a native plane factor has an error 10,000 times as large, or more, without a word."""
    graph, values = everything()
    for factor in map(graph.at, range(graph.size())):
        copied = how(factor)
        assert type(copied) is type(factor)
        assert list(copied.keys()) == list(factor.keys())
        np.testing.assert_allclose(copied.whitenedError(values), factor.whitenedError(values), rtol=1e-9, atol=1e-9)


def test_a_copied_graph_shares_nothing():
    graph, values = everything()
    sizes = graph.size(), values.size()
    copied, copied_values = factors.copy_graph(graph, values)
    assert copied.size() == graph.size()
    assert copied.error(copied_values) == pytest.approx(graph.error(values), rel=1e-9)
    copied.resize(0)
    copied_values.clear()
    assert (graph.size(), values.size()) == sizes
