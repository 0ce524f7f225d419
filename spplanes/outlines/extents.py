"""Outlines of one plane united, flattened into another plane, mended; and extents, all that was seen of a plane.

Extents are kept in tiles, so that growing costs what is new.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spplanes._check import FloatArray

#: Side of a tile, and how far each reaches into its neighbours so that simplified borders leave no gap between, m.
_TILE_M, _LAP_M = 4.0, 0.05
#: So many patches wait before they are cut into tiles together: neighbours in time, they show much the same.
_AT_ONCE = 4
#: Outlines are simplified to this after every union, m: far below any gap that association looks at.
_TOLERANCE_M = 0.01


class Extent:
    """A growing part of a plane, in the plane's (x, y): polygons, segments, or both.

    Laser lines alone, all of one wall, stay one segment.
    """

    def __init__(self, geometry: BaseGeometry) -> None:
        self._line: BaseGeometry | None = None
        self._tiles: dict[tuple[int, int], BaseGeometry] = {}
        self._waiting: list[BaseGeometry] = []
        self._full: set[tuple[int, int]] = set()
        self.bounds: FloatArray = np.array([np.inf, np.inf, -np.inf, -np.inf])
        """(x low, y low, x high, y high), shape (4,), m."""
        self.grow(geometry)
        self._whole: BaseGeometry | None = geometry

    @property
    def geometry(self) -> BaseGeometry:
        """All of it as one geometry."""
        if self._whole is None:
            self._whole = self._line if self._line is not None else shapely.union_all(all_valid(self.pieces))
        return self._whole

    @property
    def pieces(self) -> list[BaseGeometry]:
        """All of it in pieces, which overlap: for whoever needs no outline."""
        return [self._line] if self._line is not None else [*self._tiles.values(), *self._waiting]

    @property
    def corners(self) -> FloatArray:
        """Corners of all pieces, shape (N, 2), m."""
        return shapely.get_coordinates(self.pieces)

    def grow(self, patch: BaseGeometry) -> None:
        """Take a patch in."""
        low, high = np.split(np.asarray(patch.bounds), 2)
        self.bounds = np.concatenate((np.minimum(self.bounds[:2], low), np.maximum(self.bounds[2:], high)))
        areas = self._tiles or self._waiting or (self._line is not None and self._line.geom_type != "LineString")
        if not areas and patch.geom_type in ("LineString", "Point"):
            self._line, self._whole = patch if self._line is None else grow(self._line, patch), None
            return
        if self._line is not None:
            line, self._line = self._line, None
            self._cut(line)
        self._waiting.append(patch)
        self._whole = None
        if len(self._waiting) == _AT_ONCE:
            waiting, self._waiting = self._waiting, []
            self._cut(shapely.union_all(all_valid(waiting)))

    def is_within(self, distance_m: float, patch: BaseGeometry) -> bool:
        """Whether the extent comes within a distance of a patch."""
        return any(piece.distance(patch) <= distance_m for piece in self._pieces_about(patch, distance_m))

    def distance(self, patch: BaseGeometry, up_to_m: float) -> float:
        """Distance of the extent from a patch, m; `up_to_m` where it is no less."""
        return min((up_to_m, *(float(piece.distance(patch)) for piece in self._pieces_about(patch, up_to_m))))

    def _pieces_about(self, patch: BaseGeometry, distance_m: float) -> Iterator[BaseGeometry]:
        """The pieces that may come within a distance of a patch."""
        if self._line is not None:
            yield self._line
            return
        reach = np.asarray(patch.bounds) + np.array([-1.0, -1.0, 1.0, 1.0]) * distance_m
        x0, y0 = np.floor((reach[:2] - _LAP_M) / _TILE_M).tolist()
        x1, y1 = np.floor((reach[2:] + _LAP_M) / _TILE_M).tolist()
        if (x1 - x0 + 1.0) * (y1 - y0 + 1.0) > len(self._tiles):
            touched = (key for key in sorted(self._tiles) if x0 <= key[0] <= x1 and y0 <= key[1] <= y1)
        else:
            keys = product(range(int(x0), int(x1) + 1), range(int(y0), int(y1) + 1))
            touched = (key for key in keys if key in self._tiles)
        yield from (self._tiles[key] for key in touched)
        yield from self._waiting

    def _cut(self, patch: BaseGeometry) -> None:
        """Take a patch in, cut along the tiles: into columns first, and those all at once into rows."""
        x0, y0, x1, y1 = np.floor(np.asarray(patch.bounds) / _TILE_M).astype(int).tolist()
        if (x0, y0) == (x1, y1):
            self._join({} if patch.is_empty else {(x0, y0): patch})
            return
        low_x, low_y, high_x, high_y = (np.asarray(patch.bounds) + _LAP_M * np.array([-1.0, -1.0, 1.0, 1.0])).tolist()
        columns = np.full(x1 - x0 + 1, patch)
        for i in range(x0, x1 + 1) if x1 > x0 else ():
            if any((i, j) not in self._full for j in range(y0, y1 + 1)):
                left, right = i * _TILE_M - _LAP_M, (i + 1) * _TILE_M + _LAP_M
                columns[i - x0] = _within(patch, left, low_y, right, high_y)
        pieces: dict[tuple[int, int], BaseGeometry] = {}
        for j in range(y0, y1 + 1):
            wanted = np.array([i for i in range(x0, x1 + 1) if (i, j) not in self._full], dtype=int)
            bottom, top = j * _TILE_M - _LAP_M, (j + 1) * _TILE_M + _LAP_M
            row = _within(columns[wanted - x0], low_x, bottom, high_x, top)
            there = ~shapely.is_empty(row)
            pieces.update(((i, j), piece) for i, piece in zip(wanted[there].tolist(), row[there], strict=True))
        self._join(dict(sorted(pieces.items())))

    def _join(self, pieces: dict[tuple[int, int], BaseGeometry]) -> None:
        """Take pieces into their tiles, where they tell something new."""
        new = [key for key in pieces if key not in self._tiles]
        grown = dict(zip(new, all_valid([pieces[key] for key in new]), strict=True))
        known = [key for key in pieces if key in self._tiles]
        larger = grow_all([self._tiles[key] for key in known], [pieces[key] for key in known])
        grown.update((known[k], one) for k, one in larger.items())
        if not grown:
            return
        self._whole = None
        self._tiles.update(grown)
        areas = np.asarray(shapely.area(list(grown.values())))
        full = (_TILE_M + 2.0 * _LAP_M) ** 2 - 1e-4  # what else is seen there is not looked at
        self._full.update(key for key, area in zip(grown, areas.tolist(), strict=True) if area > full)


def _within(geometries: Any, x_low: float, y_low: float, x_high: float, y_high: float) -> Any:
    """What of a geometry, or of each of an array, lies in a rectangle."""
    try:
        return shapely.clip_by_rect(geometries, x_low, y_low, x_high, y_high)
    except shapely.errors.GEOSException:  # a corner that pokes in by less than a rounding leaves a ring of two points
        return shapely.intersection(all_valid(geometries), shapely.box(x_low, y_low, x_high, y_high))


def lift(points: FloatArray, transform: FloatArray) -> FloatArray:
    """Points (N, 2), lying in z = 0, or (N, 3) through a (4, 4) transform, shape (N, 3)."""
    return points @ transform[:3, : points.shape[1]].T + transform[:3, 3]


def settle_frames(frames: FloatArray, normals: FloatArray, distances: FloatArray) -> FloatArray:
    """Plane frames (N, 4, 4), moved the shortest way onto the planes of normals (N, 3) and Hesse distances (N,). x
    keeps its direction as far as it can; the origin is projected."""
    x_axes = frames[:, :3, 0] - normals * np.einsum("ni,ni->n", normals, frames[:, :3, 0])[:, None]
    x_axes /= np.linalg.norm(x_axes, axis=1, keepdims=True)
    settled = np.tile(np.eye(4), (len(frames), 1, 1))
    settled[:, :3, 0], settled[:, :3, 1], settled[:, :3, 2] = x_axes, np.cross(normals, x_axes), normals
    origins = frames[:, :3, 3]
    settled[:, :3, 3] = origins + normals * (distances - np.einsum("ni,ni->n", normals, origins))[:, None]
    return settled


def flatten(outline: BaseGeometry, plane_T_outline: FloatArray) -> BaseGeometry:
    """An outline in one plane frame, seen along the normal of another, in that one's (x, y)."""
    return shapely.transform(outline, lambda xy: lift(xy, plane_T_outline)[:, :2])


def grow(outline: BaseGeometry, patch: BaseGeometry) -> BaseGeometry:
    """Union of an outline and a patch in the same plane, with no more corners than it needs."""
    if outline.geom_type == "LineString" and patch.geom_type in ("LineString", "Point"):
        return _cover_on_line(outline, patch)
    return shapely.union(valid(outline), valid(patch)).simplify(_TOLERANCE_M)


def grow_all(outlines: Sequence[BaseGeometry], patches: Sequence[BaseGeometry]) -> dict[int, BaseGeometry]:
    """`grow` of many valid outlines at once, those by number that do not cover their patch already; valid again."""
    here, there = np.array(outlines, dtype=object), np.array(patches, dtype=object)
    new = np.flatnonzero(~shapely.covers(here, there)).tolist()
    simple = all_valid(shapely.simplify(shapely.union(here[new], all_valid(there[new])), _TOLERANCE_M))
    grown = dict(zip(new, simple, strict=True))
    return grown | {k: grow(outlines[k], patches[k]) for k in new if outlines[k].geom_type == "LineString"}


def all_valid(geometries: Sequence[BaseGeometry] | np.ndarray) -> np.ndarray:
    """The geometries themselves, or their repairs where rings cross themselves."""
    array = np.array(geometries, dtype=object)
    bad = ~shapely.is_valid(array)
    if bad.any():
        array[bad] = shapely.make_valid(array[bad])
    return array


def valid(geometry: BaseGeometry) -> BaseGeometry:
    """The geometry itself, or its repair where rings cross themselves."""
    return geometry if geometry.is_valid else shapely.make_valid(geometry)


def _cover_on_line(outline: BaseGeometry, patch: BaseGeometry) -> BaseGeometry:
    """The segment along the outline's own direction that covers both: repeated sightings of one wall line."""
    ends = shapely.get_coordinates(outline)[[0, -1]]
    direction = ends[1] - ends[0]
    length = float(np.linalg.norm(direction))
    both = np.vstack((ends, shapely.get_coordinates(patch)))
    along = (both - ends[0]) @ direction / length
    return shapely.LineString([ends[0] + direction / length * t for t in (along.min(), along.max())])
