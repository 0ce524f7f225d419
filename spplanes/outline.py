"""Outlines of planar regions: what the quads of a region cover, as a polygon with holes in plane coordinates.

A region's quads are drawn on a raster that does not turn with the plane: the projection along the world axis nearest to
the first normal. So outlines grow scan after scan, and those of two regions unite, without keeping points.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from shapely import MultiPolygon, Polygon, box, union_all

from spplanes._check import FloatArray

#: A cell is (region, i, j) in one int64: 21 bits for each of i and j, offset to be positive.
_BITS, _OFFSET = 21, 1 << 20
_MASK = (1 << _BITS) - 1
#: A plane is not projected along an axis with which its normal has less than this cosine.
STEEPEST = 0.2
#: Patches of one region that lie apart are bridged by closing the outline with up to this many cells.
_BRIDGES = (1.0, 2.0, 4.0, 8.0, 16.0)


@njit(cache=True)
def projection_axis(nx, ny, nz):
    """World axis (0, 1, 2) along which a plane with this normal is projected: that of its largest component."""
    if abs(nz) >= abs(nx) and abs(nz) >= abs(ny):
        return 2
    return 1 if abs(ny) >= abs(nx) else 0


@njit(cache=True)
def draw_quads(above, below, labels_above, labels_below, axes, cell, keys, count):
    """Append the cells whose centres lie in the triangles between two rows that belong to one region.

    Args:
        above, below: neighbouring rows of points, shape (B, 3), m.
        labels_above, labels_below: their regions, shape (B,), negative = none.
        axes: projection axis of every region, shape (R,).
        cell: side of the cells of every region, shape (R,), m.
        keys: buffer of cells, int64; grown as needed.
        count: number of cells in it.

    Returns:
        (keys, count): the buffer, possibly a new one, and the number of cells now.
    """
    for j in range(above.shape[0] - 1):
        a, b, c, d = labels_above[j], labels_above[j + 1], labels_below[j + 1], labels_below[j]
        if a >= 0 and a == c:
            if a == b:
                keys, count = _draw(above[j], above[j + 1], below[j + 1], a, axes[a], cell[a], keys, count)
            if a == d:
                keys, count = _draw(above[j], below[j + 1], below[j], a, axes[a], cell[a], keys, count)
        elif b >= 0 and b == d:
            if a == b:
                keys, count = _draw(above[j], above[j + 1], below[j], b, axes[b], cell[b], keys, count)
            if c == b:
                keys, count = _draw(above[j + 1], below[j + 1], below[j], b, axes[b], cell[b], keys, count)
    return keys, count


@njit(cache=True)
def _draw(p, q, r, region, axis, cell, keys, count):
    """Append the cells whose centres lie in the projected triangle pqr."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    s = 1.0 / cell
    px, py, qx, qy, rx, ry = p[u] * s, p[v] * s, q[u] * s, q[v] * s, r[u] * s, r[v] * s
    i0, i1 = np.ceil(min(px, qx, rx) - 0.5), np.floor(max(px, qx, rx) - 0.5)
    j0, j1 = np.ceil(min(py, qy, ry) - 0.5), np.floor(max(py, qy, ry) - 0.5)
    if i1 < i0 or j1 < j0 or max(abs(i0), abs(i1), abs(j0), abs(j1)) >= _OFFSET:
        return keys, count
    for i in range(int(i0), int(i1) + 1):
        for j in range(int(j0), int(j1) + 1):
            x, y = i + 0.5, j + 0.5
            e = (qx - px) * (y - py) - (qy - py) * (x - px)
            f = (rx - qx) * (y - qy) - (ry - qy) * (x - qx)
            g = (px - rx) * (y - ry) - (py - ry) * (x - rx)
            if (e >= 0.0 and f >= 0.0 and g >= 0.0) or (e <= 0.0 and f <= 0.0 and g <= 0.0):
                if count == keys.shape[0]:
                    larger = np.empty(2 * count + 1024, dtype=np.int64)
                    larger[:count] = keys
                    keys = larger
                keys[count] = ((region << _BITS | (i + _OFFSET)) << _BITS) | (j + _OFFSET)
                count += 1
    return keys, count


def cells_of(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Region (K,) and cell (K, 2) of every key."""
    cells = np.stack(((keys >> _BITS & _MASK) - _OFFSET, (keys & _MASK) - _OFFSET), axis=1)
    return keys >> (2 * _BITS), cells


def in_projection(cells: np.ndarray, axes: np.ndarray, axis: int, cell: float, frame: FloatArray) -> np.ndarray:
    """Cells (K, 2) of one plane that were drawn along different axes (K,), all along the one given, distinct.

    Those drawn along an axis that the plane, better known by now, turned out to be almost parallel to are left out.
    """
    usable = np.abs(frame[axes, 2]) > STEEPEST
    cells, axes = cells[usable], axes[usable]
    other = axes != axis
    if not other.any():
        return cells
    moved = cells.copy()
    for old in np.unique(axes[other]):
        mine = axes == old
        x_y = _lift((cells[mine] + 0.5) * cell, int(old), frame)
        world = frame[:3, 3] + x_y @ frame[:3, :2].T
        moved[mine] = np.floor(world[:, [(axis + 1) % 3, (axis + 2) % 3]] / cell)
    return np.unique(moved, axis=0)


def outline_from_cells(cells: np.ndarray, cell: float, axis: int, frame: FloatArray) -> Polygon | None:
    """Polygon in plane coordinates around cells of a region, m; None when there is no cell.

    Args:
        cells: shape (K, 2), int64, distinct.
        cell: side of a cell, m.
        axis: projection axis of the cells.
        frame: world_T_plane, shape (4, 4).
    """
    if not len(cells):
        return None
    corner = cells.min(axis=0)
    filled = np.zeros(cells.max(axis=0) - corner + 3, dtype=np.bool_)
    filled[cells[:, 0] - corner[0] + 1, cells[:, 1] - corner[1] + 1] = True
    vertices, ends, parts = _trace(filled)
    plane_vertices = _lift((vertices + (corner - 1)) * cell, axis, frame)
    rings = np.split(plane_vertices, ends[:-1])
    return _one_polygon(_assemble(rings, parts), cell)


def _lift(flat: FloatArray, axis: int, frame: FloatArray) -> FloatArray:
    """Plane coordinates of the points of the plane that project to ``flat`` (N, 2)."""
    n, origin = frame[:3, 2], frame[:3, 3]
    u, v = (axis + 1) % 3, (axis + 2) % 3
    delta = np.empty((len(flat), 3))
    delta[:, u], delta[:, v] = flat[:, 0] - origin[u], flat[:, 1] - origin[v]
    delta[:, axis] = -(delta[:, u] * n[u] + delta[:, v] * n[v]) / n[axis]
    return delta @ frame[:3, :2]


def _assemble(rings: list[FloatArray], parts: np.ndarray) -> list[Polygon]:
    """Polygons with holes: in every part the ring of the largest area is the shell."""
    polygons = []
    for part in range(int(parts.max()) + 1):
        mine = [ring for ring, p in zip(rings, parts, strict=True) if p == part]
        areas = [abs(np.sum(r[:, 0] * np.roll(r[:, 1], -1) - r[:, 1] * np.roll(r[:, 0], -1))) for r in mine]
        shell = int(np.argmax(areas))
        polygons.append(Polygon(mine[shell], [ring for k, ring in enumerate(mine) if k != shell]))
    return polygons


def _one_polygon(polygons: list[Polygon], cell: float) -> Polygon:
    """One valid polygon without the steps of the raster; parts are joined by closing the gaps between them."""
    with np.errstate(all="ignore"):  # GEOS divides by the length of edges, zero where a spike folds back
        return _joined(polygons, cell)


def _joined(polygons: list[Polygon], cell: float) -> Polygon:
    shape = union_all([p.simplify(0.75 * cell).buffer(0.0) for p in polygons])
    for bridge in _BRIDGES:
        if isinstance(shape, Polygon):
            break
        shape = shape.buffer(bridge * cell, join_style="mitre").buffer(-bridge * cell, join_style="mitre")
    if not isinstance(shape, Polygon) or shape.is_empty:
        shape = max(shape.geoms if isinstance(shape, MultiPolygon) else polygons, key=lambda p: p.area)
    if shape.is_valid:
        return shape
    mended = shape.buffer(0.0)
    return mended if isinstance(mended, Polygon) else max(mended.geoms, key=lambda p: p.area)


def outline_from_extent(half_x: float, half_y: float) -> Polygon:
    """Rectangle of a patch that is too small for the raster."""
    return box(-half_x, -half_y, half_x, half_y)


@njit(cache=True)
def _trace(filled):
    """Rings around the filled cells, corners only: vertices (V, 2), end of every ring, part of every ring.

    Cells that touch at a corner only are not connected. Every side of a filled cell is walked once with the cell on
    its left; the direction of a walk is 0: +j, 1: -i, 2: -j, 3: +i.
    """
    part_of, n_cells = _parts(filled)
    n_i, n_j = filled.shape
    seen = np.zeros((n_i, n_j, 4), dtype=np.bool_)
    vertices = np.empty((4 * n_cells + 1, 2), dtype=np.float64)
    ends, parts = np.empty(4 * n_cells + 1, dtype=np.int64), np.empty(4 * n_cells + 1, dtype=np.int64)
    n_vertices, n_rings = 0, 0
    di, dj = np.array([0, -1, 0, 1]), np.array([1, 0, -1, 0])
    for i0 in range(1, n_i - 1):
        for j0 in range(1, n_j - 1):
            for d0 in range(4):
                if not filled[i0, j0] or seen[i0, j0, d0] or filled[i0 + di[(d0 + 3) % 4], j0 + dj[(d0 + 3) % 4]]:
                    continue
                i, j, d = i0, j0, d0
                while not seen[i, j, d]:
                    seen[i, j, d] = True
                    a, b = i + di[d], j + dj[d]
                    right = (d + 3) % 4
                    if not filled[a, b]:
                        vertices[n_vertices] = _corner(i, j, d)
                        n_vertices += 1
                        d = (d + 1) % 4
                    elif filled[a + di[right], b + dj[right]]:
                        vertices[n_vertices] = _corner(i, j, d)
                        n_vertices += 1
                        i, j, d = a + di[right], b + dj[right], right
                    else:
                        i, j = a, b
                ends[n_rings], parts[n_rings] = n_vertices, part_of[i0, j0]
                n_rings += 1
    return vertices[:n_vertices], ends[:n_rings], parts[:n_rings]


@njit(cache=True)
def _corner(i, j, d):
    """End of the side of cell (i, j) that is walked in direction d, the cell on its left."""
    if d == 0:
        return i + 1.0, j + 1.0
    if d == 1:
        return i + 0.0, j + 1.0
    if d == 2:
        return i + 0.0, j + 0.0
    return i + 1.0, j + 0.0


@njit(cache=True)
def _parts(filled):
    """Number of the 4-connected part of every filled cell, -1 elsewhere, and the number of filled cells."""
    part = np.full(filled.shape, -1, dtype=np.int64)
    stack = np.empty((filled.size, 2), dtype=np.int64)
    n_parts, n_cells = 0, 0
    for i0 in range(filled.shape[0]):
        for j0 in range(filled.shape[1]):
            if not filled[i0, j0] or part[i0, j0] >= 0:
                continue
            top = 1
            stack[0, 0], stack[0, 1] = i0, j0
            part[i0, j0] = n_parts
            while top > 0:
                top -= 1
                i, j = stack[top, 0], stack[top, 1]
                n_cells += 1
                for d in range(4):
                    a, b = i + (d == 3) - (d == 1), j + (d == 0) - (d == 2)
                    if filled[a, b] and part[a, b] < 0:
                        part[a, b] = n_parts
                        stack[top, 0], stack[top, 1] = a, b
                        top += 1
            n_parts += 1
    return part, n_cells
