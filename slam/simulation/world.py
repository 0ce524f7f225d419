"""Worlds made of planar patches and round bars: exact ranges of rays, and the truth about every plane in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from shapely import MultiPolygon, Polygon, box, transform, unary_union

from slam.geometry.polygons import largest_polygon
from spplanes._check import FloatArray
from spplanes._jit import inlined, njit
from spplanes.plane import Plane

#: Label of a beam that hit no plane: no return, or a round bar.
NO_PLANE = -1
#: A hole in a patch: (u0, v0, u1, v1) along its two edges, m.
Hole = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class World:
    """Rectangles that belong to planes, and round bars that belong to none."""

    planes: list[Plane]
    """The true planes; labels are indices into this list. Covariances are zero, outlines are what can be hit."""
    rectangles: FloatArray
    """A corner of each rectangle, its first edge, and its second, orthogonal to the first, shape (R, 3, 3), m."""
    plane_of_rectangle: np.ndarray
    """Index of the plane a rectangle belongs to, shape (R,), int32."""
    bars: FloatArray
    """One end of the axis of each bar, from that end to the other, and its radius, shape (C, 7), m."""

    def cast(self, origins: FloatArray, rays: FloatArray, scan_normals: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """Exact ranges (S, B), infinity for nothing, and plane labels (S, B) int32, -1 for none; see `cast_scans`."""
        ranges, hits = cast_scans(origins, np.ascontiguousarray(rays), scan_normals, self.rectangles, self.bars)
        bars, nothing = np.full(len(self.bars), NO_PLANE), [NO_PLANE]  # hit -1, nothing, is the last entry
        return ranges, np.concatenate([self.plane_of_rectangle, bars, nothing])[hits].astype(np.int32)


@dataclass(frozen=True, eq=False)
class Surface:
    """A plane under construction: its patches as polygons in the coordinates (u, v) of its first patch."""

    corner: FloatArray
    u: FloatArray
    v: FloatArray
    toward: FloatArray
    patches: list[Polygon]

    @property
    def seen(self) -> Polygon | MultiPolygon:
        """All of it that can be hit."""
        patches = unary_union(self.patches)
        assert isinstance(patches, (Polygon, MultiPolygon))
        return patches

    def plane_of(self, outline: Polygon | MultiPolygon) -> Plane:
        """The plane with the largest piece of an outline: frame at its centroid, x along the longer side."""
        u, v = self.u, self.v
        middle = self.corner + outline.centroid.x * u + outline.centroid.y * v
        normal = np.cross(u, v)
        normal *= 1.0 if normal @ (self.toward - middle) > 0.0 else -1.0
        low_u, low_v, high_u, high_v = outline.bounds
        x_axis = u if high_u - low_u >= high_v - low_v else v
        frame = frame_at(middle, x_axis, np.cross(normal, x_axis), normal)
        turn, centroid = frame[:3, :2].T @ np.column_stack([u, v]), np.array([outline.centroid.x, outline.centroid.y])
        moved = transform(outline, lambda uv: (uv - centroid) @ turn.T)
        return Plane(frame=frame, covariance=np.zeros((3, 3)), outline=largest_polygon(moved))


@dataclass
class WorldBuilder:
    """Collects patches, boxes and bars; `build` gives the world."""

    _rectangles: list[tuple[FloatArray, int]] = field(default_factory=list)
    _bars: list[FloatArray] = field(default_factory=list)
    surfaces: list[Surface] = field(default_factory=list)

    def add_patch(
        self,
        corner: ArrayLike,
        u: ArrayLike,
        v: ArrayLike,
        *,
        toward: ArrayLike,
        holes: Sequence[Hole] = (),
        plane: int | None = None,
    ) -> int:
        """Add the rectangle corner + a u + b v less its holes, seen from the point `toward`; the index of its plane.

        `u` and `v` are orthogonal edges whose lengths are those of the rectangle, m. With `plane` the rectangle
        enlarges a plane that is there already: a floor that goes on into a niche.
        """
        corner, u, v = (np.asarray(x, dtype=np.float64) for x in (corner, u, v))
        length_u, length_v = float(np.linalg.norm(u)), float(np.linalg.norm(v))
        unit_u, unit_v = u / length_u, v / length_v
        if plane is None:
            plane = len(self.surfaces)
            self.surfaces.append(Surface(corner, unit_u, unit_v, np.asarray(toward, dtype=np.float64), []))
        surface = self.surfaces[plane]
        to_uv = np.column_stack([surface.u, surface.v])
        for u0, v0, u1, v1 in _cells_without_holes(length_u, length_v, holes):
            start, edge_u, edge_v = corner + u0 * unit_u + v0 * unit_v, (u1 - u0) * unit_u, (v1 - v0) * unit_v
            self._rectangles.append((np.array((start, edge_u, edge_v)), plane))
            low, high = ((x - surface.corner) @ to_uv for x in (start, start + edge_u + edge_v))
            surface.patches.append(box(*np.minimum(low, high), *np.maximum(low, high)))
        return plane

    def add_box(self, low: Sequence[float], high: Sequence[float], *, hidden: Sequence[str] = ()) -> list[int]:
        """Add the faces of an axis-aligned box, seen from outside, but the `hidden` ones of "x-", "x+", "y-" ..."""
        low_corner, high_corner = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        span = np.diag(high_corner - low_corner)
        indices = []
        for axis, name in enumerate("xyz"):
            u, v = span[axis - 2], span[axis - 1]
            for side, corner, out in (("-", low_corner, -span[axis]), ("+", low_corner + span[axis], span[axis])):
                if name + side not in hidden:
                    indices.append(self.add_patch(corner, u, v, toward=corner + out))
        return indices

    def add_bar(self, foot: ArrayLike, end: ArrayLike, radius: float) -> None:
        """Add a round bar or pillar between two points, m. It belongs to no plane."""
        start = np.asarray(foot, dtype=np.float64)
        self._bars.append(np.array((*start, *(np.asarray(end, dtype=np.float64) - start), radius)))

    def build(self) -> World:
        """The world so far."""
        return World(
            planes=[surface.plane_of(surface.seen) for surface in self.surfaces],
            rectangles=np.array([rectangle for rectangle, _ in self._rectangles]).reshape(-1, 3, 3),
            plane_of_rectangle=np.array([plane for _, plane in self._rectangles], dtype=np.int32),
            bars=np.array(self._bars, dtype=np.float64).reshape(-1, 7),
        )


def frame_at(origin: FloatArray, *axes: FloatArray) -> FloatArray:
    """A frame (4, 4) at a place, with three axes."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = np.column_stack(axes), origin
    return frame


def _cells_without_holes(length_u: float, length_v: float, holes: Sequence[Hole]) -> list[Hole]:
    """Cut a rectangle into rectangles (u0, v0, u1, v1) that leave its holes out: columns between hole edges."""
    cuts = sorted({0.0, length_u, *(x for hole in holes for x in (hole[0], hole[2]))})
    cells = []
    for u0, u1 in pairwise(cuts):
        blocked = sorted((h[1], h[3]) for h in holes if h[0] < u1 and h[2] > u0)
        bottom = 0.0
        for low, high in [*blocked, (length_v, length_v)]:
            if low > bottom:
                cells.append((u0, bottom, u1, low))
            bottom = max(bottom, high)
    return cells


#: Hits closer than this do not count: the ray starts on the surface.
NEAREST_M = 1e-6
#: Index of a ray that hits nothing.
NOTHING = -1


@inlined
def _crosses(rectangle, origin, normal):
    """Whether a rectangle has corners on both sides of the plane through `origin`, or on it."""
    first, span_u, span_v = 0.0, 0.0, 0.0
    for k in range(3):
        first += normal[k] * (rectangle[0, k] - origin[k])
        span_u += normal[k] * rectangle[1, k]
        span_v += normal[k] * rectangle[2, k]
    low = first + min(span_u, 0.0) + min(span_v, 0.0)
    high = first + max(span_u, 0.0) + max(span_v, 0.0)
    return low <= 0.0 <= high


@inlined
def _nearer_rectangle(rectangle, origin, rays, index, ranges, hits):
    """Enter the rectangle corner + a u + b v, 0 <= a, b <= 1, where a ray of the scan hits it first."""
    corner, edge_u, edge_v = rectangle[0], rectangle[1], rectangle[2]
    nx = edge_u[1] * edge_v[2] - edge_u[2] * edge_v[1]
    ny = edge_u[2] * edge_v[0] - edge_u[0] * edge_v[2]
    nz = edge_u[0] * edge_v[1] - edge_u[1] * edge_v[0]
    dx, dy, dz = corner[0] - origin[0], corner[1] - origin[1], corner[2] - origin[2]
    offset = nx * dx + ny * dy + nz * dz
    length_u = edge_u[0] ** 2 + edge_u[1] ** 2 + edge_u[2] ** 2
    length_v = edge_v[0] ** 2 + edge_v[1] ** 2 + edge_v[2] ** 2
    for b in range(len(rays)):
        slope = nx * rays[b, 0] + ny * rays[b, 1] + nz * rays[b, 2]
        if slope * offset <= 0.0:
            continue
        t = offset / slope
        if not NEAREST_M < t < ranges[b]:
            continue
        px, py, pz = t * rays[b, 0] - dx, t * rays[b, 1] - dy, t * rays[b, 2] - dz
        along_u = px * edge_u[0] + py * edge_u[1] + pz * edge_u[2]
        along_v = px * edge_v[0] + py * edge_v[1] + pz * edge_v[2]
        if 0.0 <= along_u <= length_u and 0.0 <= along_v <= length_v:
            ranges[b], hits[b] = t, index


@inlined
def _hit_bar(bar, origin, ray):
    """Distance along the unit `ray` to the mantle of the bar foot + a axis, 0 <= a <= 1; infinity for a miss."""
    foot, axis, radius = bar[:3], bar[3:6], bar[6]
    length2 = axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2
    dx, dy, dz = origin[0] - foot[0], origin[1] - foot[1], origin[2] - foot[2]
    ray_a = (ray[0] * axis[0] + ray[1] * axis[1] + ray[2] * axis[2]) / length2
    off_a = (dx * axis[0] + dy * axis[1] + dz * axis[2]) / length2
    rx, ry, rz = ray[0] - ray_a * axis[0], ray[1] - ray_a * axis[1], ray[2] - ray_a * axis[2]
    ox, oy, oz = dx - off_a * axis[0], dy - off_a * axis[1], dz - off_a * axis[2]
    a = rx * rx + ry * ry + rz * rz
    b = rx * ox + ry * oy + rz * oz
    c = ox * ox + oy * oy + oz * oz - radius * radius
    root = b * b - a * c
    if a == 0.0 or root < 0.0:
        return np.inf
    root = np.sqrt(root)
    for t in ((-b - root) / a, (-b + root) / a):
        if t > NEAREST_M and 0.0 <= off_a + t * ray_a <= 1.0:
            return t
    return np.inf


@njit(cache=True)
def cast_scans(origins, rays, scan_normals, rectangles, bars):
    """Nearest hit of every ray of every scan.

    Args:
        origins: where each scan starts, shape (S, 3), m.
        rays: unit directions in the world, shape (S, B, 3).
        scan_normals: normal of the plane that all rays of a scan lie in, shape (S, 3); zero for scans in 3D. Objects
            that do not cross that plane are left out at once.
        rectangles: corner, first edge and second edge of each, orthogonal, shape (R, 3, 3), m.
        bars: one end of the axis of each, from there to the other end, radius, shape (C, 7), m.

    Returns:
        ranges (S, B), infinity where nothing was hit; hits (S, B) int32: index of the rectangle, R + index of the
        bar, or `NOTHING`.
    """
    n_scans, n_beams = rays.shape[0], rays.shape[1]
    ranges, hits = np.empty((n_scans, n_beams)), np.empty((n_scans, n_beams), dtype=np.int32)
    for s in range(n_scans):
        ranges[s], hits[s] = np.inf, NOTHING
        for r in range(len(rectangles)):
            if _crosses(rectangles[r], origins[s], scan_normals[s]):
                _nearer_rectangle(rectangles[r], origins[s], rays[s], r, ranges[s], hits[s])
        for c in range(len(bars)):
            for b in range(n_beams):
                t = _hit_bar(bars[c], origins[s], rays[s, b])
                if t < ranges[s, b]:
                    ranges[s, b], hits[s, b] = t, len(rectangles) + c
    return ranges, hits
