"""Polygons: outlines of planes as shapely geometries, grown, flattened into another plane, taken apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from slam.geometry.frames import lift
from spplanes._check import FloatArray

Key = TypeVar("Key")

#: Outlines are simplified to this after every union, m: far below any gap that association looks at.
_TOLERANCE_M = 0.01
#: Outlines measured may lie this share of the root of their area off, and this much at most, m: less than the distance
#: between the points at the borders of large ones.
_COARSE_SHARE, _COARSEST_M = 0.02, 0.1


def flatten(outline: BaseGeometry, plane_T_outline: FloatArray) -> BaseGeometry:
    """An outline in one plane frame, seen along the normal of another, in that one's (x, y)."""
    return shapely.transform(outline, lambda xy: lift(xy, plane_T_outline)[:, :2])


def coarse(outlines: Sequence[shapely.Polygon]) -> list[shapely.Polygon]:
    """Outlines with no more corners than their size needs: the border of a large one may be rougher."""
    given = np.array(outlines, dtype=object)
    simple = shapely.simplify(given, np.minimum(_COARSEST_M, _COARSE_SHARE * np.sqrt(shapely.area(given))))
    good = (shapely.get_type_id(simple) == shapely.GeometryType.POLYGON) & ~shapely.is_empty(simple)
    return np.where(good, simple, given).tolist()


def grow(outline: BaseGeometry, patch: BaseGeometry) -> BaseGeometry:
    """Union of an outline and a patch in the same plane, with no more corners than it needs."""
    if outline.geom_type == "LineString" and patch.geom_type in ("LineString", "Point"):
        return _cover_on_line(outline, patch)
    return shapely.union(valid(outline), valid(patch)).simplify(_TOLERANCE_M)


def grow_all(
    outlines: Sequence[BaseGeometry], patches: Sequence[BaseGeometry], names: Sequence[Key]
) -> dict[Key, BaseGeometry]:
    """`grow` of many valid outlines at once, those by name that do not cover their patch already; valid again."""
    here, there = np.array(outlines, dtype=object), np.array(patches, dtype=object)
    new = np.flatnonzero(~shapely.covers(here, there))
    simple = all_valid(shapely.simplify(shapely.union(here[new], all_valid(there[new])), _TOLERANCE_M))
    grown = {names[k]: one for k, one in zip(new.tolist(), simple, strict=True)}
    lines = [k for k in new.tolist() if outlines[k].geom_type == "LineString"]
    return grown | {names[k]: grow(outlines[k], patches[k]) for k in lines}


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


def _cover_on_line(outline: BaseGeometry, patch: BaseGeometry) -> BaseGeometry:
    """The segment along the outline's own direction that covers both: repeated sightings of one wall line."""
    ends = shapely.get_coordinates(outline)[[0, -1]]
    direction = ends[1] - ends[0]
    length = float(np.linalg.norm(direction))
    both = np.vstack((ends, shapely.get_coordinates(patch)))
    along = (both - ends[0]) @ direction / length
    return shapely.LineString([ends[0] + direction / length * t for t in (along.min(), along.max())])
