"""Polygons: outlines of planes as shapely geometries, coarsened and taken apart; `spplanes.outlines` grows them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spplanes._check import FloatArray
from spplanes.outlines.extents import flatten as flatten
from spplanes.outlines.extents import valid as valid


def coarse(outlines: Sequence[shapely.Polygon]) -> list[shapely.Polygon]:
    """Outlines with no more corners than their size needs: they may lie off by a share of the root of their area, and
    by 0.1 m at most, less than the distance between the points at the borders of large ones."""
    given = np.array(outlines, dtype=object)
    simple = shapely.simplify(given, np.minimum(0.1, 0.02 * np.sqrt(shapely.area(given))))
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
