"""Copies of factors and graphs are the factors and graphs."""

import copy
import pickle

import gtsam
import numpy as np
import pytest

from factors import copy_graph, direction_prior, line_factor, plane_factor
from tests.factors.factor_scenes import A, L, X, random_line, random_plane, random_pose, values_of


def factors():
    rng = np.random.default_rng(3)
    plane = random_plane(rng)
    yield plane_factor(plane, X, L, anchor_key=A)
    yield plane_factor(plane, X, L, anchor_key=A, robust="huber")
    yield plane_factor(plane, X, L)
    yield line_factor(random_line(rng), random_pose(rng), X, L, anchor_key=A)
    yield direction_prior(L, [0.0, 0.0, 1.0], 0.1)


def some_values():
    rng = np.random.default_rng(4)
    return values_of(x0=random_pose(rng), a0=random_pose(rng), l0=gtsam.OrientedPlane3(np.array([0.6, 0.0, 0.8, -2.0])))


@pytest.mark.parametrize("how", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])  # noqa: S301
def test_a_copied_factor_has_the_same_error(how):
    """GTSAM's own copy of a native plane factor has an error 10,000 times as large, or more, without a word."""
    values = some_values()
    for factor in factors():
        copied = how(factor)
        assert type(copied) is type(factor)
        assert list(copied.keys()) == list(factor.keys())
        np.testing.assert_allclose(copied.whitenedError(values), factor.whitenedError(values), rtol=1e-9, atol=1e-9)


def test_a_foreign_custom_factor_is_refused_as_before():
    noise = gtsam.noiseModel.Unit.Create(1)
    foreign = gtsam.CustomFactor(noise, [X], lambda *_: np.zeros(1))
    with pytest.raises(TypeError, match="cannot pickle 'CustomFactor' object: factor 0: expected a factor that can be"):
        copy.deepcopy(foreign)


def test_a_copied_graph_shares_nothing():
    graph, values = gtsam.NonlinearFactorGraph(), some_values()
    for factor in factors():
        graph.push_back(factor)
    copied, copied_values = copy_graph(graph, values)
    assert copied.size() == graph.size()
    assert copied.error(copied_values) == pytest.approx(graph.error(values), rel=1e-9)
    copied.resize(0)
    copied_values.clear()
    assert graph.size() == 5
    assert values.size() == 3
    with pytest.raises(ValueError, match="graph: expected a NonlinearFactorGraph, got list"):
        copy_graph([])
