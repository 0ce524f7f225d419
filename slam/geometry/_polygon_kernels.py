"""Kernel of polygons: whether two come near each other, in a microsecond where a geometry engine takes fifty."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner


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
        geometries = np.array([shapely.Polygon() if one is None else one for one in outlines], dtype=object)
        parts, owner = shapely.get_parts(geometries, return_index=True)
        rings, part = shapely.get_rings(parts, return_index=True)
        corners, ring = shapely.get_coordinates(rings, return_index=True)
        ends = np.searchsorted(ring, np.arange(len(rings) + 1))
        return cls(corners, ends, np.searchsorted(owner[part], np.arange(len(geometries) + 1)))


@inlined
def come_near(corners, ends, others, other_ends, gap):
    """Whether two polygons, even-odd, have points no farther apart than a gap.

    Args:
        corners, ends: rings of the one, as in `Rings`, shapes (C, 2) and (R + 1,).
        others, other_ends: of the other.
        gap: not below nought.
    """
    if not _boxes_come_near(corners, others, gap):
        return False
    for r in range(ends.size - 1):
        if _contains(others, other_ends, corners[ends[r], 0], corners[ends[r], 1]):
            return True
    for r in range(other_ends.size - 1):
        if _contains(corners, ends, others[other_ends[r], 0], others[other_ends[r], 1]):
            return True
    for r in range(ends.size - 1):
        for k in range(ends[r], ends[r + 1] - 1):
            for s in range(other_ends.size - 1):
                for m in range(other_ends[s], other_ends[s + 1] - 1):
                    if _sides_come_near(corners[k], corners[k + 1], others[m], others[m + 1], gap):
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
        for k in range(ends[r], ends[r + 1] - 1):
            y0, y1 = corners[k, 1], corners[k + 1, 1]
            if (y0 > y) != (y1 > y):
                x0, x1 = corners[k, 0], corners[k + 1, 0]
                if x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                    inside = not inside
    return inside


@inlined
def _sides_come_near(a, b, c, d, gap):
    """Whether two segments have points no farther apart than a gap."""
    for axis in range(2):
        if min(a[axis], b[axis]) > max(c[axis], d[axis]) + gap or min(c[axis], d[axis]) > max(a[axis], b[axis]) + gap:
            return False
    one, two = _side(a, b, c) * _side(a, b, d), _side(c, d, a) * _side(c, d, b)
    if one < 0.0 and two < 0.0:
        return True
    square = min(_square(a, c, d), _square(b, c, d), _square(c, a, b), _square(d, a, b))
    return square <= gap * gap


@inner(cache=True)
def _side(a, b, p):
    """On which side of the line from a to b a point lies: the sign."""
    return (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])


@inner(cache=True)
def _square(p, a, b):
    """Square of the distance of a point from a segment."""
    x, y, length = b[0] - a[0], b[1] - a[1], (b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2
    along = 0.0
    if length > 0.0:
        along = min(max(((p[0] - a[0]) * x + (p[1] - a[1]) * y) / length, 0.0), 1.0)
    return (p[0] - a[0] - along * x) ** 2 + (p[1] - a[1] - along * y) ** 2
