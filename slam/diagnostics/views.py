"""What lasers and 3D sensors saw from different keyframes, held against each other: confirmed, or seen through."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy.raster import LEAST_GAP_M, MOVABLE_M, free_standing
from slam.frontend.scan_surfaces import ON_EDGE, WIDTH, moved
from slam.geometry.frames import evenly, way_to
from slam.loop_closure.candidates import nearest_of_each
from slam.registration.visibility import NEIGHBOURS_APART, Scan
from spplanes._check import FloatArray

#: A return is of the same surface, or in front of it, by more than this, m: what a map may err by before it is wrong.
TOLERANCE_M = 0.1

#: What one keyframe saw, by level lasers or by 3D sensors, to be asked what it says of what another one saw.
V = TypeVar("V", "View", "ScanView")


def one_of_each_cell(places: FloatArray) -> np.ndarray:
    """Of places (N, 2) or (N, 3) the first in every square or cube of 0.5 m, ascending rows (M,).

    Neighbours are of one surface, and say the same.
    """
    _, first = np.unique(np.floor(places / 0.5).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)


def way_along(poses: FloatArray) -> FloatArray:
    """How far along the way poses (N, 4, 4) are, in stretches of 2 m, which look at one place together, shape (N,)."""
    return way_to(poses) / 2.0


def pairs_of(views: Sequence[int], poses: FloatArray) -> list[tuple[int, int]]:
    """Keyframes to compare by poses (N, 4, 4) of all: each with the nearest of some 8 other stretches of the way.

    Further apart than 4 m what one sees of the other's surroundings is at a slant.
    """
    places, way = poses[:, :2, 3], way_along(poses)
    held, pairs = np.asarray(views), []
    if not len(held):
        return []
    tree = KDTree(places[held])
    for index in views:
        near = held[sorted(tree.query_ball_point(places[index], 4.0))]
        near = near[near != index]
        away = np.linalg.norm(places[near] - places[index], axis=1)
        stretch = np.floor(np.abs(way[near] - way[index])).astype(int)
        chosen = nearest_of_each(near, away, stretch)
        pairs += [(index, other) for other in chosen[evenly(len(chosen), 8)].tolist()]
    return pairs[:: max(1, -(-len(pairs) // 3000))]  # the sample of a long run is as good


def compare(view: V, other: V, here_T_other: FloatArray) -> tuple[int, int]:
    """How many looks of another view at a pose (4, 4) a view confirms, and how many it sees through."""
    return held_against(view, view.placed(other.looks, here_T_other))


def held_against(view: View | ScanView, places: FloatArray) -> tuple[int, int]:
    """How many places of surfaces a view confirms, and how many it sees through."""
    confirmed = view.confirms(places)
    return int(confirmed.sum()), int((view.sees_through(places) & ~confirmed).sum())


@dataclass(frozen=True, eq=False)
class View:
    """The returns of one keyframe in its body's plane of motion, to be asked what they say of places about it."""

    fans: tuple[tuple[FloatArray, FloatArray, FloatArray], ...]
    """Of every laser its place (2,), bearings (B,) ascending, rad, and ranges (B,), m."""
    tree: KDTree
    """The returns."""
    looks: FloatArray
    """One return in every square, shape (N, 2), m; of nothing that stands free, for that may be gone for others."""

    @classmethod
    def of(cls, beams: FloatArray) -> View:
        """From beams (B, 4) as rows (x0, y0, x1, y1), m."""
        origins, of_origin = np.unique(beams[:, :2], axis=0, return_inverse=True)
        fans, fixed = [], np.ones(len(beams), dtype=bool)
        for number, origin in enumerate(origins):
            rows = np.flatnonzero(of_origin.ravel() == number)
            away = beams[rows, 2:] - origin
            bearings = np.arctan2(away[:, 1], away[:, 0])
            order = np.argsort(bearings, kind="stable")
            fans.append((origin, bearings[order], np.linalg.norm(away, axis=1)[order]))
            step = float(np.median(np.diff(bearings[order]))) if len(order) > 1 else 1.0
            fixed[rows[order]] = free_standing(away[order], step) < 0
        ends = beams[fixed, 2:]
        return cls(tuple(fans), KDTree(beams[:, 2:]), ends[one_of_each_cell(ends)])

    def placed(self, looks: FloatArray, here_T_other: FloatArray) -> FloatArray:
        """Another view's looks (N, 2) as seen from here, shape (N, 2)."""
        return looks @ here_T_other[:2, :2].T + here_T_other[:2, 3]

    def confirms(self, places: FloatArray) -> np.ndarray:
        """Which places (N, 2) have a return within the tolerance, shape (N,)."""
        return np.isfinite(self.tree.query(places, distance_upper_bound=TOLERANCE_M)[0])

    def sees_through(self, places: FloatArray) -> np.ndarray:
        """Which places (N, 2) lie in front of what both beams beside them met, by more than the tolerance, (N,)."""
        through = np.zeros(len(places), dtype=bool)
        for origin, bearings, ranges in self.fans:
            if len(bearings) < 2:
                continue
            away = places - origin
            bearing = np.arctan2(away[:, 1], away[:, 0])
            after = np.clip(np.searchsorted(bearings, bearing), 1, len(bearings) - 1)
            low, high = bearings[after - 1], bearings[after]
            # between beams further apart than a few steps of a laser of 0.5 or 1 deg nothing is known to be free
            between = (high - low < np.deg2rad(2.2)) & (bearing >= low) & (bearing <= high)
            free_m = np.minimum(ranges[after], ranges[after - 1]) - TOLERANCE_M
            through |= between & (np.linalg.norm(away, axis=1) < free_m)
        return through


def views_of(keyframes: Sequence[Keyframe]) -> dict[int, View]:
    """The views of the keyframes that level lasers saw something from."""
    return {
        index: View.of(keyframe.returns)
        for index, keyframe in enumerate(keyframes)
        if keyframe.returns is not None and len(keyframe.returns)
    }


class ScanView:
    """All that a 3D sensor saw from one keyframe, to be asked what it says of what another one saw.

    Its looks are walls: elements (N, 9) that face level to 30 deg, one in every cube, on no thing that is narrower than
    `MOVABLE_M`, for that may be gone for others. Where edges are depends on who looks; where on a floor a body is its
    floor and ceiling do not tell.
    """

    def __init__(self, scan: Scan, up: FloatArray) -> None:
        """A scan, and the direction up (3,) in its body."""
        self._scan = scan
        walls = scan.elements[(scan.elements[:, 7] != ON_EDGE) & (np.abs(scan.elements[:, 3:6] @ up) < 0.5)]
        walls = walls[~_movable(walls, scan.viewpoint, up)]
        self.looks = walls[one_of_each_cell(walls[:, :3])]

    def placed(self, looks: FloatArray, here_T_other: FloatArray) -> FloatArray:
        """Another view's looks (N, 9) as seen from here, shape (N, 9)."""
        return moved(looks, here_T_other)

    def confirms(self, places: FloatArray) -> np.ndarray:
        """Which elements (N, 9) lie on a surface that was seen, to the tolerance, shape (N,)."""
        return ~self._scan.apart(places[:, :3], TOLERANCE_M) | (self._scan.off_surfaces(places) < TOLERANCE_M)

    def sees_through(self, places: FloatArray) -> np.ndarray:
        """Which elements (N, 9) stand before all that was seen about their direction by more than that, (N,)."""
        # nearer at least by the share of the range that elements are wide
        return self._scan.through(places[:, :3], TOLERANCE_M, 0.03)


def scan_views_of(keyframes: Sequence[Keyframe], poses: FloatArray) -> dict[int, ScanView]:
    """The views of the keyframes that 3D sensors saw something from; up is what is by their poses (N, 4, 4)."""
    found = {}
    for index, keyframe in enumerate(keyframes):
        if keyframe.surfaces is not None and keyframe.viewpoint is not None and len(keyframe.surfaces):
            found[index] = ScanView(Scan(keyframe.surfaces, keyframe.viewpoint), poses[index][2, :3])
    return found


def _movable(elements: FloatArray, viewpoint: FloatArray, up: FloatArray) -> np.ndarray:
    """Which elements (N, 9) are of things that are narrower, seen from above, than what walks, shape (N,)."""
    points = elements[:, :3]
    if len(points) < 2:
        return np.ones(len(points), dtype=bool)
    # further apart than all of these they are of two surfaces
    limit = np.maximum(0.1 * np.linalg.norm(points - viewpoint, axis=1), NEIGHBOURS_APART * elements[:, WIDTH])
    limit = np.maximum(LEAST_GAP_M, limit)
    about = min(9, len(points))  # itself, and eight about it
    apart, near = KDTree(points).query(points, k=about, distance_upper_bound=float(limit.max()))
    mine, which = np.nonzero(apart < limit[:, None])
    links = coo_array((np.ones(len(mine)), (mine, np.asarray(near)[mine, which])), shape=(len(points),) * 2)
    count, thing = connected_components(links, directed=False)
    level = points - np.outer(points @ up, up)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, thing, level)
    np.maximum.at(high, thing, level)
    return (np.linalg.norm(high - low, axis=1) < MOVABLE_M)[thing]
