"""What 3D sensors saw from different keyframes: walls confirmed, or seen through."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from slam.diagnostics.views.comparing import one_of_each_cell
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy import LEAST_GAP_M, MOVABLE_M
from slam.frontend.scan_surfaces import ON_EDGE, moved
from slam.registration.visibility import Scan, Sight
from spplanes._check import FloatArray

#: Walls face level to this, sine of 30 deg. Where on a floor a body is its floor and ceiling do not tell.
_LEVEL = 0.5
#: What stands before a surface is nearer by this share of its range at least: as wide are the elements it is made of.
_WIDE_SHARE = 0.03
#: Elements further apart than this share of their range are of two surfaces: they are 3.4 deg wide at most.
_APART_SHARE = 0.1
#: Neighbours of an element that may be of its surface.
_NEIGHBOURS = 8


class ScanView:
    """All that a 3D sensor saw from one keyframe, to be asked what it says of what another one saw.

    Its looks are walls: elements (N, 8) that face level, one in every cube, on no thing that is narrower
    than `MOVABLE_M`, for that may be gone for others. Where edges are depends on who looks.
    """

    def __init__(self, scan: Scan, up: FloatArray) -> None:
        """A scan, and the direction up (3,) in its body."""
        self._sight = Sight(scan)
        walls = scan.elements[(scan.elements[:, 7] != ON_EDGE) & (np.abs(scan.elements[:, 3:6] @ up) < _LEVEL)]
        walls = walls[~_movable(walls[:, :3], scan.viewpoint, up)]
        self.looks = walls[one_of_each_cell(walls[:, :3])]

    def looks_of(self, other: ScanView, here_T_other: FloatArray) -> FloatArray:
        """Another view's looks as seen from here, shape (N, 8)."""
        return moved(other.looks, here_T_other)

    def confirms(self, places: FloatArray, tolerance_m: float) -> np.ndarray:
        """Which elements (N, 8) lie on a surface that was seen, to the tolerance, shape (N,)."""
        return (self._sight.apart(places[:, :3]) < tolerance_m) | (self._sight.off_surfaces(places) < tolerance_m)

    def sees_through(self, places: FloatArray, tolerance_m: float) -> np.ndarray:
        """Which elements (N, 8) stand before all that was seen about their direction by more than that, (N,)."""
        return self._sight.through(places[:, :3], tolerance_m, _WIDE_SHARE)


def scan_views_of(keyframes: Sequence[Keyframe], poses: FloatArray) -> dict[int, ScanView]:
    """The views of the keyframes that 3D sensors saw something from; up is what is by their poses (N, 4, 4)."""
    found = {}
    for index, keyframe in enumerate(keyframes):
        if keyframe.surfaces is not None and keyframe.viewpoint is not None and len(keyframe.surfaces):
            found[index] = ScanView(Scan(keyframe.surfaces, keyframe.viewpoint), poses[index][2, :3])
    return found


def _movable(points: FloatArray, viewpoint: FloatArray, up: FloatArray) -> np.ndarray:
    """Which points (N, 3) are of things that are narrower, seen from above, than what walks, shape (N,)."""
    if len(points) < 2:
        return np.ones(len(points), dtype=bool)
    apart, near = KDTree(points).query(points, k=min(_NEIGHBOURS + 1, len(points)))
    limit = np.maximum(LEAST_GAP_M, _APART_SHARE * np.linalg.norm(points - viewpoint, axis=1))
    mine, which = np.nonzero(apart < limit[:, None])
    links = coo_array((np.ones(len(mine)), (mine, np.asarray(near)[mine, which])), shape=(len(points),) * 2)
    count, thing = connected_components(links, directed=False)
    level = points - np.outer(points @ up, up)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, thing, level)
    np.maximum.at(high, thing, level)
    return (np.linalg.norm(high - low, axis=1) < MOVABLE_M)[thing]
