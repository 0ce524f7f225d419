"""Polygons: outlines of planes as shapely geometries, coarsened and taken apart; whether two come near, as a kernel.

`spplanes.outlines` grows them. A geometry engine takes fifty microseconds to say whether two come near, the kernel one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner, njit
from spplanes.outlines.extents import flatten as flatten
from spplanes.outlines.extents import valid as valid

#: Outlines measured may lie this share of the root of their area off, and this much at most, m: less than the distance
#: between the points at the borders of large ones.
_COARSE_SHARE, _COARSEST_M = 0.02, 0.1


def coarse(outlines: Sequence[shapely.Polygon]) -> list[shapely.Polygon]:
    """Outlines with no more corners than their size needs: the border of a large one may be rougher."""
    given = np.array(outlines, dtype=object)
    simple = shapely.simplify(given, np.minimum(_COARSEST_M, _COARSE_SHARE * np.sqrt(shapely.area(given))))
    good = (shapely.get_type_id(simple) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(simple)
    return np.where(good, simple, given).tolist()


def polygons_of(geometry: BaseGeometry) -> list[shapely.Polygon]:
    """All polygons of a geometry, however nested."""
    return [part for part in _singles(geometry) if isinstance(part, shapely.Polygon) and not part.is_empty]


def segments_of(geometry: BaseGeometry) -> list[FloatArray]:
    """All line strings of a geometry as arrays of corners (N, 2)."""
    return [shapely.get_coordinates(part) for part in _singles(geometry) if isinstance(part, shapely.LineString)]


def largest_polygon(geometry: BaseGeometry) -> shapely.Polygon | None:
    """The largest polygon of a geometry; None when it has none."""
    return max(polygons_of(geometry), key=lambda part: part.area, default=None)


def polygonal(geometry: BaseGeometry) -> shapely.Polygon | shapely.MultiPolygon | None:
    """All polygons of a geometry as one; None when it has none."""
    parts = polygons_of(geometry)
    return shapely.MultiPolygon(parts) if len(parts) > 1 else parts[0] if parts else None


def _singles(geometry: BaseGeometry) -> list[BaseGeometry]:
    if not hasattr(geometry, "geoms"):
        return [geometry]
    return [single for part in shapely.get_parts(geometry) for single in _singles(part)]


class Rings(NamedTuple):
    """Rings of several polygons, outer ones and holes alike, as arrays."""

    corners: FloatArray
    """Of all rings, the last of each the first again, shape (C, 2), m."""
    ends: np.ndarray
    """First corner of each ring, and the number of corners, shape (R + 1,)."""
    of: np.ndarray
    """First ring of each polygon, and the number of rings, shape (N + 1,)."""

    @classmethod
    def of_all(cls, outlines: Sequence[BaseGeometry | None]) -> Rings:
        """Of polygons, multipolygons, or nothing."""
        geometries = np.array([shapely.Polygon() if outline is None else outline for outline in outlines], dtype=object)
        parts, owner = shapely.get_parts(geometries, return_index=True)
        rings, part = shapely.get_rings(parts, return_index=True)
        corners, ring = shapely.get_coordinates(rings, return_index=True)
        ends = np.searchsorted(ring, np.arange(len(rings) + 1))
        return cls(corners, ends, np.searchsorted(owner[part], np.arange(len(geometries) + 1)))


@njit(cache=True)
def come_near(corners, ends, others, other_ends, gap):
    """Whether two polygons, even-odd, have points no farther apart than a gap.

    Args:
        corners, ends: rings of the one, as in `Rings`, shapes (C, 2) and (R + 1,); ends count from the first on.
        others, other_ends: of the other.
        gap: not below nought.
    """
    first, other_first = ends[0], other_ends[0]
    if not _boxes_come_near(corners, others, gap):
        return False
    for r in range(ends.size - 1):
        if _contains(others, other_ends, corners[ends[r] - first, 0], corners[ends[r] - first, 1]):
            return True
    for r in range(other_ends.size - 1):
        k = other_ends[r] - other_first
        if _contains(corners, ends, others[k, 0], others[k, 1]):
            return True
    for r in range(ends.size - 1):
        for k in range(ends[r] - first, ends[r + 1] - first - 1):
            for s in range(other_ends.size - 1):
                for m in range(other_ends[s] - other_first, other_ends[s + 1] - other_first - 1):
                    if _sides_come_near(corners, k, others, m, gap):
                        return True
    return False


@inlined
def _boxes_come_near(corners, others, gap):
    for axis in range(2):
        low, high, other_low, other_high = np.inf, -np.inf, np.inf, -np.inf
        for k in range(len(corners)):
            low, high = min(low, corners[k, axis]), max(high, corners[k, axis])
        for k in range(len(others)):
            other_low, other_high = min(other_low, others[k, axis]), max(other_high, others[k, axis])
        if not (low <= other_high + gap and other_low <= high + gap):
            return False
    return True


@inner(cache=True)
def _contains(corners, ends, x, y):
    """Whether a point lies within rings, even-odd."""
    inside = False
    for r in range(ends.size - 1):
        for k in range(ends[r] - ends[0], ends[r + 1] - ends[0] - 1):
            y0, y1 = corners[k, 1], corners[k + 1, 1]
            if (y0 > y) != (y1 > y):
                x0, x1 = corners[k, 0], corners[k + 1, 0]
                if x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                    inside = not inside
    return inside


@inlined
def _sides_come_near(corners, k, others, m, gap):
    """Whether two segments, from each corner to the next, have points no farther apart than a gap."""
    for axis in range(2):
        a, b, c, d = corners[k, axis], corners[k + 1, axis], others[m, axis], others[m + 1, axis]
        if min(a, b) > max(c, d) + gap or min(c, d) > max(a, b) + gap:
            return False
    one = _side(corners, k, others, m) * _side(corners, k, others, m + 1)
    two = _side(others, m, corners, k) * _side(others, m, corners, k + 1)
    if one < 0.0 and two < 0.0:
        return True
    square = min(_square(others, m, corners, k), _square(others, m, corners, k + 1))
    return min(square, _square(corners, k, others, m), _square(corners, k, others, m + 1)) <= gap * gap


@inner(cache=True)
def _side(ends, a, points, p):
    """On which side of the line from end a to the next a point lies: the sign."""
    x, y = ends[a, 0], ends[a, 1]
    return (ends[a + 1, 0] - x) * (points[p, 1] - y) - (ends[a + 1, 1] - y) * (points[p, 0] - x)


@inner(cache=True)
def _square(ends, a, points, p):
    """Square of the distance of a point from the segment from end a to the next."""
    x, y, px, py = (
        ends[a + 1, 0] - ends[a, 0],
        ends[a + 1, 1] - ends[a, 1],
        points[p, 0] - ends[a, 0],
        points[p, 1] - ends[a, 1],
    )
    along, length = 0.0, x**2 + y**2
    if length > 0.0:
        along = min(max((px * x + py * y) / length, 0.0), 1.0)
    return (px - along * x) ** 2 + (py - along * y) ** 2
