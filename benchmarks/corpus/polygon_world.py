"""Worlds with planar polygons of any tilt, holes and glass, beside rectangles and bars."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import shapely
from numpy.typing import ArrayLike
from shapely import MultiPolygon, Polygon

from slam.simulation.world import NEAREST_M, NO_PLANE, Surface, World, WorldBuilder, frame_at
from spplanes._check import FloatArray
from spplanes._jit import inlined, njit

#: Plane of a polygon of glass: beams end in it and nothing comes back.
GLASS = -2


@dataclass(frozen=True, eq=False)
class PolygonWorld(World):
    """Rectangles and polygons that belong to planes, and round bars that belong to none.

    The outline of a wall with gaps is the convex hull of what can be hit of it.
    """

    seen: list[Polygon | MultiPolygon]  # all of each plane that can be hit and no more, in (x, y) of its frame
    frames: FloatArray  # frame of each polygon, which lies in its x and y, shape (G, 4, 4), m
    edges: FloatArray  # edges of the rings of all polygons, rows (x0, y0, x1, y1) in their frames, shape (E, 4), m
    first_edges: np.ndarray
    """Where the edges of each polygon begin, and the end of the last one's, shape (G + 1,), int64."""
    plane_of_polygon: np.ndarray  # index of the plane a polygon belongs to, or `GLASS`, shape (G,), int32

    def cast(self, origins: FloatArray, rays: FloatArray, scan_normals: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """As `World.cast`."""
        ranges, labels = super().cast(origins, rays, scan_normals)
        polygons = self.frames, self.edges, self.first_edges, self.plane_of_polygon
        cast_polygons(origins, np.ascontiguousarray(rays), scan_normals, *polygons, ranges, labels)
        gone = labels == GLASS
        return np.where(gone, np.inf, ranges), np.where(gone, np.int32(NO_PLANE), labels)


@dataclass
class PolygonBuilder(WorldBuilder):
    """Collects polygons, too."""

    _polygons: list[tuple[FloatArray, FloatArray, int]] = field(default_factory=list)
    _whole: set[int] = field(default_factory=set)

    def add_polygon(
        self, rings: Sequence[ArrayLike], *, toward: ArrayLike, plane: int | None = None, glass: bool = False
    ) -> int:
        """Add a planar polygon of any tilt, seen from the point `toward`; the index of its plane, or `GLASS`.

        Rings are corners (K, 3) of the outer ring, then of its holes, m, all in one plane. A `plane` given, made of
        polygons and in the same place, is enlarged in place of a new one. Beams that end in glass do not come back.
        """
        corners = [np.asarray(ring, dtype=np.float64) for ring in rings]
        if plane is None:
            frame = _frame_of(corners[0])
        else:
            surface = self.surfaces[plane]
            frame = frame_at(surface.corner, surface.u, surface.v, np.cross(surface.u, surface.v))
        flat = [(ring - frame[:3, 3]) @ frame[:3, :2] for ring in corners]
        if glass:
            plane = GLASS
        elif plane is None:
            plane, viewer = len(self.surfaces), np.asarray(toward, dtype=np.float64)
            self.surfaces.append(Surface(frame[:3, 3], frame[:3, 0], frame[:3, 1], viewer, []))
            self._whole.add(plane)
        if plane != GLASS:
            self.surfaces[plane].patches.append(Polygon(flat[0], flat[1:]))
        edges = np.concatenate([np.column_stack([ring, np.roll(ring, -1, axis=0)]) for ring in flat])
        self._polygons.append((frame, edges, plane))
        return plane

    def build(self) -> PolygonWorld:
        """The world so far; one of polygons that lie apart has their convex hull for outline: a wall with gaps."""
        world = super().build()
        for plane in self._whole:
            surface = self.surfaces[plane]
            if isinstance(surface.seen, MultiPolygon):
                world.planes[plane] = surface.plane_of(surface.seen.convex_hull)  # type: ignore[arg-type]
        planes = zip(self.surfaces, world.planes, strict=True)
        return PolygonWorld(
            **vars(world),
            seen=[_moved(surface, plane.frame) for surface, plane in planes],
            frames=np.array([frame for frame, _, _ in self._polygons]).reshape(-1, 4, 4),
            edges=np.concatenate([np.empty((0, 4)), *(edges for _, edges, _ in self._polygons)]),
            first_edges=np.cumsum([0, *(len(edges) for _, edges, _ in self._polygons)]),
            plane_of_polygon=np.array([plane for _, _, plane in self._polygons], dtype=np.int32),
        )


def _moved(surface: Surface, frame: FloatArray) -> Polygon | MultiPolygon:
    """What can be hit of a surface, in (x, y) of the plane's frame (4, 4)."""
    axes = np.vstack((surface.u, surface.v))
    return shapely.transform(surface.seen, lambda uv: (surface.corner + uv @ axes - frame[:3, 3]) @ frame[:3, :2])


def _frame_of(ring: FloatArray) -> FloatArray:
    """A frame at the first corner of a planar ring (K, 3), x along its first edge, z its normal by Newell's sum."""
    normal = np.cross(ring - ring[0], np.roll(ring, -1, axis=0) - ring[0]).sum(axis=0)
    normal /= np.linalg.norm(normal)
    x_axis = (ring[1] - ring[0]) / np.linalg.norm(ring[1] - ring[0])
    return frame_at(ring[0], x_axis, np.cross(normal, x_axis), normal)


@inlined
def _inside(x, y, edges, first, last):
    """Whether a point of a polygon's plane is inside its rings: an odd number of edges to the right of it."""
    odd = False
    for k in range(first, last):
        x0, y0, x1, y1 = edges[k, 0], edges[k, 1], edges[k, 2], edges[k, 3]
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            odd = not odd
    return odd


@inlined
def _polygon_crosses(frame, edges, first, last, origin, normal):
    """Whether a polygon has corners on both sides of the plane through `origin`, or on it."""
    offset, slope_x, slope_y = 0.0, 0.0, 0.0
    for k in range(3):
        offset += normal[k] * (frame[k, 3] - origin[k])
        slope_x += normal[k] * frame[k, 0]
        slope_y += normal[k] * frame[k, 1]
    low, high = np.inf, -np.inf
    for k in range(first, last):
        height = offset + slope_x * edges[k, 0] + slope_y * edges[k, 1]
        low, high = min(low, height), max(high, height)
    return low <= 0.0 <= high


@njit(cache=True)
def cast_polygons(origins, rays, scan_normals, frames, edges, first_edges, planes, ranges, labels):
    """Enter the polygons that are nearer than what the rays hit so far into `ranges` and `labels`, both (S, B).

    Rays are as for `slam.simulation.world.cast_scans`, polygons as in `PolygonWorld`; z of a frame is its normal.
    """
    for s in range(rays.shape[0]):
        for g in range(frames.shape[0]):
            frame, first, last = frames[g], first_edges[g], first_edges[g + 1]
            if not _polygon_crosses(frame, edges, first, last, origins[s], scan_normals[s]):
                continue
            dx, dy, dz = frame[0, 3] - origins[s, 0], frame[1, 3] - origins[s, 1], frame[2, 3] - origins[s, 2]
            offset = frame[0, 2] * dx + frame[1, 2] * dy + frame[2, 2] * dz
            for b in range(rays.shape[1]):
                ray = rays[s, b]
                slope = frame[0, 2] * ray[0] + frame[1, 2] * ray[1] + frame[2, 2] * ray[2]
                if slope * offset <= 0.0:
                    continue
                t = offset / slope
                if not NEAREST_M < t < ranges[s, b]:
                    continue
                px, py, pz = t * ray[0] - dx, t * ray[1] - dy, t * ray[2] - dz
                x = px * frame[0, 0] + py * frame[1, 0] + pz * frame[2, 0]
                y = px * frame[0, 1] + py * frame[1, 1] + pz * frame[2, 1]
                if _inside(x, y, edges, first, last):
                    ranges[s, b], labels[s, b] = t, planes[g]
