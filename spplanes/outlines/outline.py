"""Outlines of planar regions: what the quads of a region cover, as a polygon with holes in plane coordinates.

A region of one grid is drawn in the coordinates of its plane. One that grows scan after scan is drawn on a raster that
does not turn with the plane: the projection along the world axis nearest to the first normal. So outlines of two
regions unite without keeping points.
"""

from __future__ import annotations

import numpy as np
import shapely
from shapely import Polygon, box

from spplanes._check import FloatArray
from spplanes._jit import njit
from spplanes._threads import in_parts
from spplanes.outlines._raster import draw, layout, onto_planes
from spplanes.outlines._tracing import rings_around

#: Directions in which the farthest point of a group is a corner of its hull.
CORNERS = 16


def outlines_of_grid(
    points: FloatArray, labels: np.ndarray, frames: FloatArray, cells: FloatArray
) -> list[Polygon | None]:
    """Outlines of the regions of a grid, None where one covers no cell: of points (S, B, 3), m, with labels (S, B), in
    the frames world_T_plane of the regions, (R, 4, 4), drawn in cells of sides (R,), m."""
    projections = onto_planes(frames, cells)
    filled, first, corner, shape = draw(points, labels, projections)
    return _traced(filled, first, corner, shape, 1.0 / np.linalg.norm(projections[:, 0, :3], axis=1))


def outlines_of_groups(
    points: FloatArray, groups: np.ndarray, labels: np.ndarray, frames: FloatArray, cells: FloatArray
) -> list[Polygon | None]:
    """Outlines of regions of points without order, (N, 3), m: the hulls of groups of neighbours, None where there are
    none. Groups, (N,), are small where a region ends; all else is as of `outlines_of_grid`."""
    projections = onto_planes(frames, cells)
    names, order, bounds = _groups_of(groups, labels)
    corners = _hulls_of_groups(points[order], bounds, projections[names])
    low, high = np.full((len(frames), 2), np.inf), np.full((len(frames), 2), -np.inf)
    np.minimum.at(low, names, corners.min(axis=1))
    np.maximum.at(high, names, corners.max(axis=1))
    scale, first, corner, shape = layout(low, high)
    filled = np.zeros(first[-1], dtype=np.bool_)
    _fill_convex(filled, first, corner, shape, scale, names, corners)
    return _traced(filled, first, corner, shape, cells / scale)


def _groups_of(groups: np.ndarray, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Region (G,) of the groups of three points and more, the points in their order, and bounds (G + 1,)."""
    used = np.flatnonzero(labels >= 0)
    codes = labels[used] * (groups.max(initial=0) + 1) + groups[used]
    _, inverse, counts = np.unique(codes, return_inverse=True, return_counts=True)
    used, inverse = used[counts[inverse] >= 3], inverse[counts[inverse] >= 3]
    order = used[np.argsort(inverse, kind="stable")]
    bounds = np.concatenate(([0], np.cumsum(counts[counts >= 3])))
    return labels[order[bounds[:-1]]], order, bounds


def _hulls_of_groups(points: FloatArray, bounds: np.ndarray, projections: FloatArray) -> FloatArray:
    """Corners (G, CORNERS, 2) of the hulls of groups of points, each wider by half the distance of its points. Points
    of group g are points[bounds[g]:bounds[g + 1]]; its projection, of (G, 2, 4), takes them to raster coordinates."""
    counts = np.diff(bounds)
    group, (x, y, z) = np.repeat(np.arange(len(counts)), counts), points.T
    flat = [p[group, 0] * x + p[group, 1] * y + p[group, 2] * z + p[group, 3] for p in projections.swapaxes(0, 1)]
    corners, angles = np.empty((len(counts), CORNERS, 2)), 2.0 * np.pi * np.arange(CORNERS) / CORNERS
    for d, (cosine, sine) in enumerate(zip(np.cos(angles), np.sin(angles), strict=True)):
        reach = flat[0] * cosine + flat[1] * sine
        farthest = np.flatnonzero(reach == np.maximum.reduceat(reach, bounds[:-1])[group])[::-1]  # the first is last
        corners[group[farthest], d] = np.stack(flat, axis=1)[farthest]
    u, v = np.moveaxis(corners, -1, 0)
    area = np.cumsum(0.5 * (u * np.roll(v, -1, axis=1) - np.roll(u, -1, axis=1) * v), axis=1)[:, -1]
    wider = np.maximum(np.sqrt(np.maximum(area, 0.0) / counts), 0.5)[:, None, None]
    off = corners - np.stack([np.bincount(group, one / counts[group], len(counts)) for one in flat], axis=1)[:, None]
    length = np.sqrt(off[..., :1] * off[..., :1] + off[..., 1:] * off[..., 1:])
    return corners + np.divide(wider * off, length, out=np.zeros(off.shape), where=length > 0.0)


@njit(cache=True)
def _fill_convex(filled, first, corner, shape, scale, region, corners):
    """Fill the cells of every region's raster whose centres lie in one of its convex polygons, in place."""
    for g in range(region.shape[0]):
        r = region[g]
        low, high = np.inf, -np.inf
        for d in range(CORNERS):
            u = corners[g, d, 0] * scale[r] - corner[r, 0] - 0.5
            low, high = min(low, u), max(high, u)
        for i in range(max(int(np.ceil(low)), 0), min(int(np.floor(high)), shape[r, 0] - 1) + 1):
            least, most = np.inf, -np.inf
            for d in range(CORNERS):
                e = (d + 1) % CORNERS
                u0 = corners[g, d, 0] * scale[r] - corner[r, 0] - 0.5
                u1 = corners[g, e, 0] * scale[r] - corner[r, 0] - 0.5
                v0 = corners[g, d, 1] * scale[r] - corner[r, 1] - 0.5
                v1 = corners[g, e, 1] * scale[r] - corner[r, 1] - 0.5
                if min(u0, u1) <= i <= max(u0, u1):
                    v = v0 + (v1 - v0) * (i - u0) / (u1 - u0) if u1 != u0 else v0
                    least, most = min(least, v), max(most, v)
            start = first[r] + i * shape[r, 1]
            for j in range(max(int(np.ceil(least)), 0), min(int(np.floor(most)), shape[r, 1] - 1) + 1):
                filled[start + j] = True


def _traced(
    filled: np.ndarray, first: np.ndarray, corner: np.ndarray, shape: np.ndarray, sides: FloatArray
) -> list[Polygon | None]:
    """Polygons round what is filled of rasters, in plane coordinates, m; arguments as returned by `draw`."""
    rings: list[tuple[FloatArray, np.ndarray] | None] = [None] * len(shape)
    largest_first = np.argsort(-np.diff(first), kind="stable")

    def trace(begin: int, end: int) -> None:
        for r in largest_first[begin:end]:
            raster = filled[first[r] : first[r + 1]].reshape(shape[r])
            rings[r] = rings_around(raster) if raster.any() else None

    in_parts(trace, len(shape), len(filled), singly=True)
    polygons = iter(_polygons([((ring[0] + corner[r]) * sides[r], ring[1]) for r, ring in enumerate(rings) if ring]))
    return [ring and next(polygons) for ring in rings]


def outline_from_cells(cells: np.ndarray, cell: float, axis: int, frame: FloatArray) -> Polygon | None:
    """Polygon in plane coordinates, m, of the plane with a frame (4, 4), around cells (K, 2), int64, of a side, m, that
    were drawn along an axis; None when there is no cell."""
    if not len(cells):
        return None
    corner = cells.min(axis=0)
    filled = np.zeros(cells.max(axis=0) - corner + 3, dtype=np.bool_)
    filled[cells[:, 0] - corner[0] + 1, cells[:, 1] - corner[1] + 1] = True
    vertices, ends = rings_around(filled)
    return _polygons([(_lift((vertices + (corner - 1)) * cell, axis, frame), ends)])[0]


def _polygons(rings: list[tuple[FloatArray, np.ndarray]]) -> list[Polygon]:
    """Polygons of rings, each their vertices behind each other and where every ring ends; all made at once. Those that
    simplification has made cross themselves are mended."""
    if not rings:
        return []
    counts = np.concatenate([np.diff(ends, prepend=0) for _, ends in rings])
    corners = np.concatenate(([0], np.cumsum(counts)))
    parts = np.concatenate(([0], np.cumsum([len(ends) for _, ends in rings])))
    vertices = np.concatenate([corner for corner, _ in rings])
    polygons = shapely.from_ragged_array(shapely.GeometryType.POLYGON, vertices, (corners, parts))
    good = np.asarray(shapely.is_valid(polygons))
    return [polygon if ok else _mended(polygon) for polygon, ok in zip(polygons, good.tolist(), strict=True)]


def _mended(polygon: Polygon) -> Polygon:
    """The largest piece of what a polygon that crosses itself encloses."""
    with np.errstate(all="ignore"):  # GEOS divides by the length of edges, zero where a spike folds back
        pieces = shapely.get_parts(shapely.make_valid(polygon))
    areas = [piece.area if isinstance(piece, Polygon) else -1.0 for piece in pieces]
    return pieces[int(np.argmax(areas))]


def in_projection(cells: np.ndarray, axes: np.ndarray, axis: int, cell: float, frame: FloatArray) -> np.ndarray:
    """Cells (K, 2) of one plane that were drawn along different axes (K,), all along the one given.

    Those drawn along an axis that the plane, better known by now, turned out to be almost parallel to are left out.
    """
    usable = np.abs(frame[axes, 2]) > 0.2
    cells, axes = cells[usable], axes[usable]
    moved = cells.copy()
    for old in np.unique(axes[axes != axis]):
        mine = axes == old
        x_y = _lift((cells[mine] + 0.5) * cell, int(old), frame)
        world = frame[:3, 3] + x_y @ frame[:3, :2].T
        moved[mine] = np.floor(world[:, [(axis + 1) % 3, (axis + 2) % 3]] / cell)
    return moved


def _lift(flat: FloatArray, axis: int, frame: FloatArray) -> FloatArray:
    """Plane coordinates of the points of the plane that project to ``flat`` (N, 2)."""
    n, origin = frame[:3, 2], frame[:3, 3]
    u, v = (axis + 1) % 3, (axis + 2) % 3
    delta = np.empty((len(flat), 3))
    delta[:, u], delta[:, v] = flat[:, 0] - origin[u], flat[:, 1] - origin[v]
    delta[:, axis] = -(delta[:, u] * n[u] + delta[:, v] * n[v]) / n[axis]
    return delta @ frame[:3, :2]


def outline_from_extent(half_x: float, half_y: float) -> Polygon:
    """Rectangle of a patch that is too small for the raster."""
    return box(-half_x, -half_y, half_x, half_y)
