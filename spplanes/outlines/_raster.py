"""Rasters of planar regions: the quads of a grid of points, drawn cell by cell in one projection per region."""

from __future__ import annotations

from functools import partial

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner, njit
from spplanes._threads import in_parts

#: A cell is (region, i, j) in one int64: 21 bits for each of i and j, offset to be positive.
_BITS, _OFFSET = 21, 1 << 20
#: A region with a larger raster than this, cells, is drawn with larger ones.
LARGEST_RASTER = 1 << 20


def projection_axis(nx: float, ny: float, nz: float) -> int:
    """World axis (0, 1, 2) along which a plane with this normal is projected: that of its largest component."""
    return 2 - int(np.argmax(np.abs((nz, ny, nx))))


def along_axes(axes: np.ndarray, cell: float) -> FloatArray:
    """Projections along world axes (R,) onto rasters that start at the world's origin, shape (R, 2, 4)."""
    result = np.zeros((len(axes), 2, 4))
    for k in range(2):
        result[np.arange(len(axes)), k, (axes + 1 + k) % 3] = 1.0 / cell
    return result


def onto_planes(frames: FloatArray, cells: FloatArray) -> FloatArray:
    """Projections onto the x and y of plane frames (R, 4, 4), in cells of side (R,), shape (R, 2, 4)."""
    axes = frames[:, :3, :2].transpose(0, 2, 1)
    shift = -np.einsum("rka,ra->rk", axes, frames[:, :3, 3])
    # of whatever number of planes in one layout: for each the kernels would be compiled
    return np.ascontiguousarray(np.concatenate((axes, shift[..., None]), axis=2) / cells[:, None, None])


def draw(points, labels, projections):
    """Rasters of all regions: the cells whose centres lie in a triangle of neighbouring points of one region.

    `projections` (R, 2, 4) take points to raster coordinates in cells; what is too large is scaled down in place. Given
    back are all rasters behind each other, bool, each with a frame of empty cells around it; where each begins, (R +
    1,); raster coordinates of its first cell, (R, 2); its cells along both axes, (R, 2), 0 where a region has no point.
    """
    flat, found = np.empty((*labels.shape, 2)), []
    project = partial(_project, points, labels, projections, flat)
    in_parts(lambda begin, end: found.append(project(begin, end)), len(labels), labels.size)
    low, high = np.min([part[0] for part in found], axis=0), np.max([part[1] for part in found], axis=0)
    scale, first, corner, shape = layout(low, high)
    projections *= scale[:, None, None]
    filled = np.zeros(first[-1], dtype=np.bool_)
    fill = partial(_fill, (filled, first, shape), flat, labels, (scale, corner))
    in_parts(fill, max(len(labels) - 1, 0), labels.size)
    return filled, first, corner, shape


@njit(cache=True)
def _project(points, labels, projections, flat, begin_row, end_row):
    """Raster coordinates of the labelled points, into (S, B, 2); least and largest of every region, (R, 2)."""
    n_cols, n_regions = labels.shape[1], projections.shape[0]
    low, high = np.empty((n_regions, 2)), np.empty((n_regions, 2))
    for r in range(n_regions):
        for k in range(2):
            low[r, k], high[r, k] = np.inf, -np.inf
    for i in range(begin_row, end_row):
        end = 0
        while end < n_cols:
            r, begin = labels[i, end], end
            while end < n_cols and labels[i, end] == r:
                end += 1
            for k in range(2 if r >= 0 else 0):
                x, y, z, d = projections[r, k, 0], projections[r, k, 1], projections[r, k, 2], projections[r, k, 3]
                least, most = low[r, k], high[r, k]
                for j in range(begin, end):
                    value = x * points[i, j, 0] + y * points[i, j, 1] + z * points[i, j, 2] + d
                    flat[i, j, k] = value
                    least, most = min(least, value), max(most, value)
                low[r, k], high[r, k] = least, most
    return low, high


@njit(cache=True)
def _fill(rasters, flat, labels, layout, begin, end):
    """Fill the triangles between the rows from begin to end and those below them; threads may fill the same cell, and
    as they write the same, it does not matter which is first."""
    (filled, first, shape), (scale, corner) = rasters, layout
    n_cols = labels.shape[1]
    place, inward = np.empty((2, n_cols, 2)), np.zeros((2, 4, n_cols), dtype=np.int32)
    hit = np.empty(n_cols, dtype=np.bool_)
    _cells_of_row(flat, labels, scale, corner, begin, place[begin % 2], inward[begin % 2])
    for i in range(begin, end):
        u, v = i % 2, (i + 1) % 2
        _cells_of_row(flat, labels, scale, corner, i + 1, place[v], inward[v])
        _mark_quads(inward[0], inward[1], hit)
        for j in range(n_cols - 1):
            if not hit[j]:
                continue
            a, b, c, d = labels[i, j], labels[i, j + 1], labels[i + 1, j + 1], labels[i + 1, j]
            if a >= 0 and a == c:
                if a == b:
                    _triangle(filled, first[a], shape[a, 1], (place, inward), (u, j), (u, j + 1), (v, j + 1))
                if a == d:
                    _triangle(filled, first[a], shape[a, 1], (place, inward), (u, j), (v, j + 1), (v, j))
            elif b >= 0 and b == d:
                if a == b:
                    _triangle(filled, first[b], shape[b, 1], (place, inward), (u, j), (u, j + 1), (v, j))
                if c == b:
                    _triangle(filled, first[b], shape[b, 1], (place, inward), (u, j + 1), (v, j + 1), (v, j))


@inner(cache=True)
def _cells_of_row(flat, labels, scale, corner, i, place, inward):
    """Places (B, 2) of the labelled points of a row in their own rasters, whole numbers at the centres of cells, and
    the numbers next to them: from above along both axes, then from below, shape (4, B)."""
    for j in range(labels.shape[1]):
        r = labels[i, j]
        if r >= 0:
            for k in range(2):
                place[j, k] = flat[i, j, k] * scale[r] - corner[r, k] - 0.5
                inward[k, j], inward[k + 2, j] = int(np.ceil(place[j, k])), int(np.floor(place[j, k]))


@inlined
def _mark_quads(above, below, hit):
    """Mark the quads that may hold a centre, by the box of their corners: whole rows at once, as compilers like it."""
    for j in range(hit.shape[0] - 1):
        hit[j] = True
    for k in range(2):
        for j in range(hit.shape[0] - 1):
            least = min(min(above[k, j], above[k, j + 1]), min(below[k, j], below[k, j + 1]))
            most = max(max(above[k + 2, j], above[k + 2, j + 1]), max(below[k + 2, j], below[k + 2, j + 1]))
            hit[j] &= least <= most


def layout(low: FloatArray, high: FloatArray) -> tuple[FloatArray, np.ndarray, np.ndarray, np.ndarray]:
    """Scale that keeps every raster below the largest, and where it lies; see `draw`."""
    there = (low[:, 0] <= high[:, 0])[:, None]
    low, high = np.where(there, low, 0.0), np.where(there, high, 0.0)
    a, b = (high - low).T
    large = (a + 3.0) * (b + 3.0) > LARGEST_RASTER  # the frame of a sliver does not shrink with it
    room, edge = LARGEST_RASTER - 9.0, 3.0 * (a + b)
    scale = np.where(large, 2.0 * room / (np.maximum(edge, 1.0) + np.sqrt(edge * edge + 4.0 * a * b * room)), 1.0)
    corner = np.where(there, np.floor(low * scale[:, None]).astype(np.int64) - 1, 0)
    shape = np.where(there, np.floor(high * scale[:, None]).astype(np.int64) + 2 - corner, 0)
    return scale, np.concatenate(([0], np.cumsum(shape[:, 0] * shape[:, 1]))), corner, shape


@inner(cache=True)
def _triangle(filled, first, width, rows, a, b, c):
    """Fill the cells whose centres lie in the triangle of three points, given by row, 0 or 1, and column."""
    (place, inward), (pu, p), (qu, q), (ru, r) = rows, a, b, c
    i0 = min(inward[pu, 0, p], inward[qu, 0, q], inward[ru, 0, r])
    i1 = max(inward[pu, 2, p], inward[qu, 2, q], inward[ru, 2, r])
    j0 = min(inward[pu, 1, p], inward[qu, 1, q], inward[ru, 1, r])
    j1 = max(inward[pu, 3, p], inward[qu, 3, q], inward[ru, 3, r])
    if i1 < i0 or j1 < j0:
        return
    px, py, qx, qy = place[pu, p, 0], place[pu, p, 1], place[qu, q, 0], place[qu, q, 1]
    rx, ry = place[ru, r, 0], place[ru, r, 1]
    if px > qx:
        px, py, qx, qy = qx, qy, px, py
    if qx > rx:
        qx, qy, rx, ry = rx, ry, qx, qy
        if px > qx:
            px, py, qx, qy = qx, qy, px, py
    if px == rx:
        return  # no area
    whole, rising, falling = (ry - py) / (rx - px), (qy - py) / (qx - px), (ry - qy) / (rx - qx)
    for x in range(i0, i1 + 1):  # row by row; centres within rounding of a side lie in the triangles on both sides
        one = py + (x - px) * whole
        other = py + (x - px) * rising if x < qx else (qy + (x - qx) * falling if qx < rx else qy)
        least, most = int(np.ceil(min(one, other) - 1e-9)), int(np.floor(max(one, other) + 1e-9))
        start = first + x * width
        for y in range(start + max(least, j0), start + min(most, j1) + 1):
            filled[y] = True


def keys_of(filled: np.ndarray, first: np.ndarray, corner: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """The filled cells of all rasters as keys, int64, ascending where no coordinate leaves its 21 bits."""
    places = np.flatnonzero(filled)
    region = np.searchsorted(first, places, side="right") - 1
    i, j = np.divmod(places - first[region], shape[region, 1])
    i, j = i + corner[region, 0], j + corner[region, 1]
    keys = ((region << _BITS | (i + _OFFSET)) << _BITS) | (j + _OFFSET)
    return keys[(np.abs(i) < _OFFSET) & (np.abs(j) < _OFFSET)]


def cells_of(keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Region (K,) and cell (K, 2) of every key."""
    places = np.stack((keys >> _BITS, keys), axis=1) & (1 << _BITS) - 1
    return keys >> (2 * _BITS), places - _OFFSET


def distinct(codes: np.ndarray) -> np.ndarray:
    """Every number once, ascending; for many equal ones sorting beats the hashing of `numpy.unique` ten to one."""
    ordered = np.sort(codes)
    return ordered[np.flatnonzero(np.diff(ordered, prepend=-1))] if len(ordered) else ordered


def distinct_pairs(pairs: np.ndarray, n: int) -> np.ndarray:
    """Each pair of numbers below n once, in ascending order, shape (E, 2)."""
    codes = distinct(pairs[:, 0] * n + pairs[:, 1])
    return np.stack(np.divmod(codes, max(n, 1)), axis=1)
