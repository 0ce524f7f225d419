"""What was seen from different keyframes, held against each other: surfaces confirmed, or seen through."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, Self, TypeVar

import numpy as np
from scipy.spatial import KDTree

from slam.geometry.frames import inverse, way_to
from slam.loop_closure.candidates import nearest_of_each
from spplanes._check import FloatArray

#: A return is of the same surface, or in front of it, by more than this, m: what a map may err by before it is wrong.
TOLERANCE_M = 0.1
#: One return in a cell of this side is looked at: neighbours are of one surface, and say the same, m.
_LOOK_M = 0.5
#: Keyframes further apart than this are not compared, m: what one sees of the other's surroundings is at a slant.
_REACH_M = 4.0
#: Keyframes within a stretch of the way of this length look at one place together, m.
_STRETCH_M = 2.0
#: Partners of a keyframe are from different stretches of the way, and so many at most.
_PARTNERS = 8
#: Comparisons over a whole run: the sample of a long one is as good.
_MOST_PAIRS = 3000


class Looks(Protocol):
    """What one keyframe saw, to be asked what it says of what another one saw."""

    def looks_of(self, other: Self, here_T_other: FloatArray) -> FloatArray:
        """Places, a row each, where another view has a surface to look for, as seen from here."""
        ...

    def confirms(self, places: FloatArray, tolerance_m: float) -> np.ndarray:
        """Which places have a surface within the tolerance, shape (N,)."""
        ...

    def sees_through(self, places: FloatArray, tolerance_m: float) -> np.ndarray:
        """Which places lie in front of all that was seen about their direction, shape (N,)."""
        ...


V = TypeVar("V", bound=Looks)


@dataclass(frozen=True)
class Comparison:
    """What one keyframe's view says of the surfaces that another one saw."""

    keyframe: int
    """That looks."""
    other: int
    """Whose surfaces are looked for."""
    confirmed: int
    """Looks at surfaces that are there."""
    through: int
    """Looks through surfaces: something is there for the one and nothing for the other."""


def one_of_each_cell(places: FloatArray) -> np.ndarray:
    """Of places (N, 2) or (N, 3) the first in every square or cube that is looked at once, ascending rows (M,)."""
    _, first = np.unique(np.floor(places / _LOOK_M).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)


def way_along(poses: FloatArray) -> FloatArray:
    """How far along the way poses (N, 4, 4) are, in the stretches that look at one place together, shape (N,)."""
    return way_to(poses) / _STRETCH_M


def pairs_of(views: Sequence[int], poses: FloatArray) -> list[tuple[int, int]]:
    """Keyframes to compare by poses (N, 4, 4) of all: each with the nearest of every other stretch of the way."""
    places = poses[:, :2, 3]
    way = way_along(poses)
    held, pairs = np.asarray(views), []
    if not len(held):
        return []
    tree = KDTree(places[held])
    for index in views:
        near = held[sorted(tree.query_ball_point(places[index], _REACH_M))]
        near = near[near != index]
        away = np.linalg.norm(places[near] - places[index], axis=1)
        stretch = np.floor(np.abs(way[near] - way[index])).astype(int)
        chosen = nearest_of_each(near, away, stretch)
        spread = np.unique(np.linspace(0, len(chosen) - 1, min(_PARTNERS, len(chosen))).round().astype(int))
        pairs += [(index, other) for other in chosen[spread].tolist()]
    return pairs[:: max(1, -(-len(pairs) // _MOST_PAIRS))]


def compare(view: V, other: V, here_T_other: FloatArray, tolerance_m: float = TOLERANCE_M) -> tuple[int, int]:
    """How many looks of another view at a pose (4, 4) a view confirms, and how many it sees through."""
    places = view.looks_of(other, here_T_other)
    confirmed = view.confirms(places, tolerance_m)
    return int(confirmed.sum()), int((view.sees_through(places, tolerance_m) & ~confirmed).sum())


def comparisons(views: Mapping[int, V], poses: FloatArray, pairs: Sequence[tuple[int, int]]) -> list[Comparison]:
    """Each pair of keyframes (one, other) at poses (N, 4, 4)."""
    found = []
    for one, other in pairs:
        counts = compare(views[one], views[other], inverse(poses[one]) @ poses[other])
        found.append(Comparison(one, other, *counts))
    return found
