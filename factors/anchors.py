"""In whose frame each plane landmark of a graph lives: the world's or an anchor pose's, the same in all its factors."""

from __future__ import annotations

from typing import Any

import gtsam
import gtsam_unstable

from factors._check import told_key
from factors._custom import describe
from spplanes._check import check_instance


def landmark_anchors(graph: gtsam.NonlinearFactorGraph) -> dict[int, int | None]:
    """Anchor pose of every plane landmark of a graph, None for the world, by the landmark's key.

    GTSAM cannot see the mistake of a landmark that one factor takes in the world and another in the frame of a pose: it
    solves, for something else. Here it is refused; call it once before optimising. Landmarks whose factors do not say
    where they live (priors) are left out.

    ValueError: a landmark with two anchors, or with one and in the world; the sentence names it and both.
    """
    check_instance("graph", graph, gtsam.NonlinearFactorGraph)
    anchors: dict[int, int | None] = {}
    for i in range(graph.size()):
        if not graph.exists(i):
            continue
        plane_key, anchor_key = anchoring_of(graph.at(i))
        if plane_key is not None:
            check_anchor("graph", anchors, plane_key, anchor_key)
    return anchors


def check_anchor(name: str, anchors: dict[int, int | None], plane_key: int, anchor_key: int | None) -> None:
    """Take down the anchor of a landmark; refuse another one than it has."""
    known = anchors.setdefault(plane_key, anchor_key)
    if known != anchor_key:
        raise ValueError(
            f"{name}: expected one anchor for each landmark, got two for {told_key(plane_key)}: "
            f"{_told(known)} and {_told(anchor_key)}"
        )


def anchoring_of(factor: Any) -> tuple[int | None, int | None]:
    """(plane, anchor) where the factor says in whose frame its landmark lives; (None, None) where it does not."""
    if isinstance(factor, gtsam_unstable.LocalOrientedPlane3Factor):
        keys = list(factor.keys())
        return keys[2], keys[1]
    if isinstance(factor, gtsam.OrientedPlane3Factor):
        return list(factor.keys())[-1], None
    recipe = describe(factor) if isinstance(factor, gtsam.CustomFactor) else None
    if recipe is None or recipe.reference_key is not None or recipe.pose_key is recipe.anchor_key is None:
        return None, None
    return recipe.plane_key, recipe.anchor_key


def _told(anchor_key: int | None) -> str:
    return "the world" if anchor_key is None else told_key(anchor_key)
