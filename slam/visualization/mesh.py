"""Outlines of map planes as triangles and line segments in the world."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from slam.geometry.polygons import polygons_of
from slam.planeslam import MapPlane
from spplanes._check import FloatArray

#: Colours by what a plane is, RGB in 0..255: floor-like, ceiling-like, walls by the direction they face.
FLOOR_RGB, CEILING_RGB = (150, 150, 150), (205, 205, 215)
WALL_RGB = ((196, 78, 82), (85, 132, 190), (85, 168, 104), (204, 150, 60), (129, 114, 179), (100, 181, 205))
_LEVEL_COSINE = np.cos(np.deg2rad(30.0))


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with one colour and one plane each."""

    vertices: FloatArray
    """Corners in the world, shape (V, 3), m."""
    triangles: np.ndarray
    """Indices of corners, counter-clockwise seen from the side the plane was seen from, shape (T, 3), int32."""
    plane_ids: np.ndarray
    """Landmark id of every corner, shape (V,), int32."""
    colours: np.ndarray
    """RGB of every corner, shape (V, 3), uint8."""


def mesh_of(planes: Sequence[MapPlane]) -> Mesh:
    """Triangulate the polygons of the planes, holes left open."""
    vertices, triangles, ids, colours = [np.empty((0, 3))], [np.empty((0, 3), np.int32)], [], []
    count = 0
    for plane in planes:
        corners = _triangle_corners(plane)
        world = corners @ plane.plane.frame[:3, :2].T + plane.plane.frame[:3, 3]
        vertices.append(world)
        triangles.append(np.arange(count, count + len(world), dtype=np.int32).reshape(-1, 3))
        ids += [plane.id] * len(world)
        colours += [colour_of(plane)] * len(world)
        count += len(world)
    return Mesh(
        np.concatenate(vertices),
        np.concatenate(triangles),
        np.array(ids, dtype=np.int32),
        np.array(colours, dtype=np.uint8).reshape(-1, 3),
    )


def colour_of(plane: MapPlane) -> tuple[int, int, int]:
    """Grey for floor and ceiling; walls by direction, so that facing and neighbouring walls differ."""
    normal = plane.plane.normal
    if abs(normal[2]) > _LEVEL_COSINE:
        return FLOOR_RGB if normal[2] > 0.0 else CEILING_RGB
    turns = np.arctan2(normal[1], normal[0]) / (2.0 * np.pi)
    return WALL_RGB[round(float(turns) * len(WALL_RGB)) % len(WALL_RGB)]


def _triangle_corners(plane: MapPlane) -> FloatArray:
    """Corners (3 T, 2) of a constrained triangulation of the polygons of a plane."""
    triangles = []
    for polygon in polygons_of(plane.seen):
        for triangle in shapely.get_parts(shapely.constrained_delaunay_triangles(polygon)):
            triangles.append(shapely.get_coordinates(shapely.orient_polygons(triangle))[:3])
    return np.concatenate(triangles) if triangles else np.empty((0, 2))
