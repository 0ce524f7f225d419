"""Worlds made of planar patches, polygons and round bars, with the truth about every plane in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from shapely import MultiPolygon, Polygon, box, transform, unary_union

from slam.simulation.raycast import cast_polygons, cast_scans
from spplanes._check import FloatArray
from spplanes.plane import Plane

#: Label of a beam that hit no plane: no return, or a round bar.
NO_PLANE = -1
#: Plane of a polygon of glass: beams end in it and nothing comes back.
GLASS = -2
#: A hole in a patch: (u0, v0, u1, v1) along its two edges, m.
Hole = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class World:
    """Rectangles and polygons that belong to planes, and round bars that belong to none."""

    planes: list[Plane]
    """The true planes; labels are indices into this list. Covariances are zero, outlines are what can be hit, or of a
    wall with gaps their convex hull."""
    surfaces: list[Polygon | MultiPolygon]
    """All of each plane that can be hit and no more, in (x, y) of its frame."""
    corners: FloatArray
    """A corner of each rectangle, shape (R, 3), m."""
    edges_u: FloatArray
    """First edge of each rectangle, shape (R, 3), m."""
    edges_v: FloatArray
    """Second edge of each rectangle, orthogonal to the first, shape (R, 3), m."""
    plane_of_rectangle: np.ndarray
    """Index of the plane a rectangle belongs to, shape (R,), int32."""
    feet: FloatArray
    """One end of the axis of each bar, shape (C, 3), m."""
    axes: FloatArray
    """From that end to the other, shape (C, 3), m."""
    radii: FloatArray
    """Radius of each bar, shape (C,), m."""
    frames: FloatArray
    """Frame of each polygon, which lies in its x and y, shape (G, 4, 4), m."""
    edges: FloatArray
    """Edges of the rings of all polygons, rows (x0, y0, x1, y1) in their frames, shape (E, 4), m."""
    first_edges: np.ndarray
    """Where the edges of each polygon begin, and the end of the last one's, shape (G + 1,), int64."""
    plane_of_polygon: np.ndarray
    """Index of the plane a polygon belongs to, or `GLASS`, shape (G,), int32."""

    def cast(self, origins: FloatArray, rays: FloatArray, scan_normals: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """Exact ranges (S, B), infinity for nothing, and plane labels (S, B) int32, -1 for no plane.

        Args:
            origins: shape (S, 3), m.
            rays: unit directions in the world, shape (S, B, 3).
            scan_normals: normal of each scan's plane, shape (S, 3); zero where the rays do not lie in one.
        """
        shapes = (self.corners, self.edges_u, self.edges_v, self.feet, self.axes, self.radii)
        rays = np.ascontiguousarray(rays)
        ranges, hits = cast_scans(origins, rays, scan_normals, *shapes)
        first = self.plane_of_rectangle.size + self.radii.size
        cast_polygons(origins, rays, scan_normals, self.frames, self.edges, self.first_edges, first, ranges, hits)
        bars, nothing = np.full(self.radii.size, NO_PLANE), [NO_PLANE]  # hit -1, nothing, is the last entry
        labels = np.concatenate([self.plane_of_rectangle, bars, self.plane_of_polygon, nothing])[hits]
        gone = labels == GLASS
        return np.where(gone, np.inf, ranges), np.where(gone, NO_PLANE, labels).astype(np.int32)


@dataclass(frozen=True, eq=False)
class _Surface:
    """A plane under construction: its patches as polygons in the coordinates (u, v) of its first patch."""

    corner: FloatArray
    u: FloatArray
    v: FloatArray
    toward: FloatArray
    patches: list[Polygon]
    whole: bool = False
    """Whether patches that lie apart count as one outline, their convex hull: a wall with gaps for doors."""


@dataclass
class WorldBuilder:
    """Collects patches, boxes and bars; `build` gives the world."""

    _rectangles: list[tuple[FloatArray, FloatArray, FloatArray, int]] = field(default_factory=list)
    _bars: list[tuple[FloatArray, FloatArray, float]] = field(default_factory=list)
    _surfaces: list[_Surface] = field(default_factory=list)
    _polygons: list[tuple[FloatArray, FloatArray, int]] = field(default_factory=list)

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
            plane = len(self._surfaces)
            self._surfaces.append(_Surface(corner, unit_u, unit_v, np.asarray(toward, dtype=np.float64), []))
        surface = self._surfaces[plane]
        to_uv = np.column_stack([surface.u, surface.v])
        for u0, v0, u1, v1 in _cells_without_holes(length_u, length_v, holes):
            start, edge_u, edge_v = corner + u0 * unit_u + v0 * unit_v, (u1 - u0) * unit_u, (v1 - v0) * unit_v
            self._rectangles.append((start, edge_u, edge_v, plane))
            low, high = ((x - surface.corner) @ to_uv for x in (start, start + edge_u + edge_v))
            surface.patches.append(box(*np.minimum(low, high), *np.maximum(low, high)))
        return plane

    def add_polygon(
        self,
        rings: Sequence[ArrayLike],
        *,
        toward: ArrayLike,
        plane: int | None = None,
        glass: bool = False,
    ) -> int:
        """Add a planar polygon of any tilt, seen from the point `toward`; the index of its plane, or `GLASS`.

        Args:
            rings: corners (K, 3) of the outer ring, then of its holes, m; all in the plane of the outer ring.
            toward: a point on the side it is seen from, m.
            plane: enlarge this plane, made of polygons and in the same place, in place of a new one.
            glass: beams end here and do not come back; it is no plane of the truth.
        """
        corners = [np.asarray(ring, dtype=np.float64) for ring in rings]
        if plane is None:
            frame = _frame_of(corners[0])
        else:
            surface = self._surfaces[plane]
            frame = _frame(surface.corner, surface.u, surface.v, np.cross(surface.u, surface.v))
        flat = [(ring - frame[:3, 3]) @ frame[:3, :2] for ring in corners]
        if glass:
            plane = GLASS
        elif plane is None:
            plane, viewer = len(self._surfaces), np.asarray(toward, dtype=np.float64)
            self._surfaces.append(_Surface(frame[:3, 3], frame[:3, 0], frame[:3, 1], viewer, [], whole=True))
        if plane != GLASS:
            self._surfaces[plane].patches.append(Polygon(flat[0], flat[1:]))
        edges = np.concatenate([np.column_stack([ring, np.roll(ring, -1, axis=0)]) for ring in flat])
        self._polygons.append((frame, edges, plane))
        return plane

    def add_box(self, low: Sequence[float], high: Sequence[float], *, hidden: Sequence[str] = ()) -> list[int]:
        """Add the faces of an axis-aligned box, seen from outside, but the `hidden` ones of "x-", "x+", "y-" ..."""
        low_corner, high_corner = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        span = np.diag(high_corner - low_corner)
        indices = []
        for axis, name in enumerate("xyz"):
            u, v = span[(axis + 1) % 3], span[(axis + 2) % 3]
            for side, corner in (("-", low_corner), ("+", low_corner + span[axis])):
                if name + side not in hidden:
                    outside = corner + (span[axis] if side == "+" else -span[axis])
                    indices.append(self.add_patch(corner, u, v, toward=outside))
        return indices

    def add_bar(self, foot: ArrayLike, end: ArrayLike, radius: float) -> None:
        """Add a round bar or pillar between two points, m. It belongs to no plane."""
        start = np.asarray(foot, dtype=np.float64)
        self._bars.append((start, np.asarray(end, dtype=np.float64) - start, radius))

    def build(self) -> World:
        """The world so far."""
        corners, edges_u, edges_v, planes = zip(*self._rectangles, strict=True) if self._rectangles else ((),) * 4
        true = [_true_plane(surface) for surface in self._surfaces]
        return World(
            planes=[plane for plane, _ in true],
            surfaces=[surface for _, surface in true],
            corners=_stack(corners),
            edges_u=_stack(edges_u),
            edges_v=_stack(edges_v),
            plane_of_rectangle=np.array(planes, dtype=np.int32),
            feet=_stack([bar[0] for bar in self._bars]),
            axes=_stack([bar[1] for bar in self._bars]),
            radii=np.array([bar[2] for bar in self._bars], dtype=np.float64),
            frames=np.array([frame for frame, _, _ in self._polygons]).reshape(-1, 4, 4),
            edges=np.concatenate([np.empty((0, 4)), *(edges for _, edges, _ in self._polygons)]),
            first_edges=np.cumsum([0, *(len(edges) for _, edges, _ in self._polygons)]),
            plane_of_polygon=np.array([plane for _, _, plane in self._polygons], dtype=np.int32),
        )


def _frame_of(ring: FloatArray) -> FloatArray:
    """A frame at the first corner of a planar ring (K, 3), x along its first edge, z its normal by Newell's sum."""
    normal = np.cross(ring - ring[0], np.roll(ring, -1, axis=0) - ring[0]).sum(axis=0)
    normal /= np.linalg.norm(normal)
    x_axis = (ring[1] - ring[0]) / np.linalg.norm(ring[1] - ring[0])
    return _frame(ring[0], x_axis, np.cross(normal, x_axis), normal)


def _frame(origin: FloatArray, *axes: FloatArray) -> FloatArray:
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = np.column_stack(axes), origin
    return frame


def _stack(rows: Sequence[FloatArray]) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(len(rows), 3)


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


def _true_plane(surface: _Surface) -> tuple[Plane, Polygon | MultiPolygon]:
    """The plane with its patch, and all of its patches: frame at the patch's centroid, x along the longer side."""
    patches = unary_union(surface.patches)
    assert isinstance(patches, (Polygon, MultiPolygon))
    whole = patches.convex_hull if surface.whole and isinstance(patches, MultiPolygon) else patches
    assert isinstance(whole, (Polygon, MultiPolygon))
    u, v = surface.u, surface.v
    middle = surface.corner + whole.centroid.x * u + whole.centroid.y * v
    normal = np.cross(u, v)
    normal *= 1.0 if normal @ (surface.toward - middle) > 0.0 else -1.0
    low_u, low_v, high_u, high_v = whole.bounds
    x_axis = u if high_u - low_u >= high_v - low_v else v
    frame = _frame(middle, x_axis, np.cross(normal, x_axis), normal)
    uv_to_xy, centroid = frame[:3, :2].T @ np.column_stack([u, v]), np.array([whole.centroid.x, whole.centroid.y])
    outline, seen = (transform(one, lambda uv: (uv - centroid) @ uv_to_xy.T) for one in (whole, patches))
    piece = max(outline.geoms, key=lambda g: g.area) if isinstance(outline, MultiPolygon) else outline
    return Plane(frame=frame, covariance=np.zeros((3, 3)), outline=piece), seen
