"""One landmark lives in one frame: the world's, or that of one anchor."""

import gtsam
import numpy as np
import pytest

from factors import landmark_anchors, parallel_factor, plane_factor, plane_factors, plane_prior, upright_prior
from tests.factors.factor_scenes import A, L, X, random_plane

PLANE = random_plane(np.random.default_rng(0))
OTHER = gtsam.symbol("l", 12)


def graph_of(*factors):
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def test_anchors_of_a_graph():
    graph = graph_of(
        plane_factor(PLANE, X, L, anchor_key=A),
        plane_factor(PLANE, A, L, anchor_key=A),
        upright_prior(L, 0.1, anchor_key=A),
        plane_factor(PLANE, X, OTHER),
        plane_prior(PLANE, OTHER),
        parallel_factor(L, OTHER, 0.1, anchor_a=A),
    )
    graph.resize(8)
    assert landmark_anchors(graph) == {L: A, OTHER: None}


@pytest.mark.parametrize(("anchor", "told"), [(None, "the world"), (X, "x0")])
def test_two_frames_for_one_landmark_are_refused(anchor, told):
    other = plane_factor(PLANE, gtsam.symbol("x", 7), OTHER, anchor_key=anchor)
    graph = graph_of(plane_factor(PLANE, X, OTHER, anchor_key=A), other)
    with pytest.raises(ValueError, match=f"graph: expected one anchor .* got two for l12: a0 and {told}"):
        landmark_anchors(graph)
    with pytest.raises(ValueError, match=f"anchor_keys: expected one anchor .* got two for l12: a0 and {told}"):
        plane_factors([PLANE, PLANE], [X, gtsam.symbol("x", 7)], [OTHER, OTHER], [A, anchor])
