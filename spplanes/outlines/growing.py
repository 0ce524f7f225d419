"""Growing outlines: polygons and segments of one plane united, flattened into another plane, mended."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from spplanes._check import FloatArray

Key = TypeVar("Key")

#: Outlines are simplified to this after every union, m: far below any gap that association looks at.
_TOLERANCE_M = 0.01


def lift(points: FloatArray, transform: FloatArray) -> FloatArray:
    """Points (N, 2), lying in z = 0, or (N, 3) through a (4, 4) transform, shape (N, 3)."""
    return points @ transform[:3, : points.shape[1]].T + transform[:3, 3]


def settle_frames(frames: FloatArray, normals: FloatArray, distances: FloatArray) -> FloatArray:
    """Plane frames (N, 4, 4), moved the shortest way onto the planes of normals (N, 3) and Hesse distances (N,).

    x keeps its direction as far as it can; the origin is projected.
    """
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


def _cover_on_line(outline: BaseGeometry, patch: BaseGeometry) -> BaseGeometry:
    """The segment along the outline's own direction that covers both: repeated sightings of one wall line."""
    ends = shapely.get_coordinates(outline)[[0, -1]]
    direction = ends[1] - ends[0]
    length = float(np.linalg.norm(direction))
    both = np.vstack((ends, shapely.get_coordinates(patch)))
    along = (both - ends[0]) @ direction / length
    return shapely.LineString([ends[0] + direction / length * t for t in (along.min(), along.max())])
