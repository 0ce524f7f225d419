"""Rings around the filled cells of a raster: one part, no pinches, few vertices."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from spplanes._check import FloatArray
from spplanes._jit import inlined, njit


def rings_around(filled: np.ndarray) -> tuple[FloatArray, np.ndarray]:
    """Rings around the filled cells, vertices (V, 2) in cells and the end of every ring (R,); the first is the shell.
    `filled`, (I, J) bool, of which something is, has an empty frame around it; it is changed in place."""
    filled = _one_part(filled)
    return _few(*_trace(filled, np.count_nonzero(filled)))


def _one_part(filled: np.ndarray) -> np.ndarray:
    """The raster without pinches and in one part: gaps closed as far as it takes, or else its largest part."""
    _fill_pinches(filled)
    parts, count = ndimage.label(filled)  # type: ignore[misc]
    if count == 1:
        return filled
    for reach in (1, 2, 4, 8, 16):
        whole = _closed(filled, reach)
        _fill_pinches(whole)
        if ndimage.label(whole)[1] == 1:  # type: ignore[misc]
            return whole
    return parts == 1 + np.bincount(parts[filled])[1:].argmax()


def _closed(filled: np.ndarray, reach: int) -> np.ndarray:
    """Closing by a square that reaches so many cells to each side."""
    wide = np.pad(filled.astype(np.uint8), reach)
    return ndimage.grey_closing(wide, 2 * reach + 1, mode="constant")[reach:-reach, reach:-reach].astype(bool)


@njit(cache=True)
def _fill_pinches(filled):
    """Fill a cell beside every two that touch at a corner only, in place, so that no ring meets itself."""
    n_i, n_j = filled.shape
    changed = True
    while changed:
        changed = False
        for i in range(1, n_i - 2):
            pinches = 0
            for j in range(1, n_j - 2):  # whole rows at once, which the compiler vectorises: hardly any has one
                a, b, c, d = filled[i, j], filled[i, j + 1], filled[i + 1, j], filled[i + 1, j + 1]
                pinches += (a != b) & (a != c) & (b != d)
            for j in range(1, n_j - 2 if pinches else 1):
                a, b, c, d = filled[i, j], filled[i, j + 1], filled[i + 1, j], filled[i + 1, j + 1]
                if a == d and b == c and a != b:
                    if a:
                        filled[i, j + 1] = True
                    else:
                        filled[i, j] = True
                    changed = True


@njit(cache=True)
def _few(vertices, ends):
    """Rings without the vertices that tell little; only a shell may be left with fewer than three."""
    kept, first, count, n_rings = np.empty(vertices.shape[0], dtype=np.bool_), 0, 0, 0
    for k in range(ends.shape[0]):
        last = ends[k]
        few = _simplify(vertices[first:last], kept[first:last]) < 3
        if k == 0 or not few:
            for v in range(first, last):
                if kept[v] or few:
                    vertices[count, 0], vertices[count, 1] = vertices[v, 0], vertices[v, 1]
                    count += 1
            ends[n_rings] = count
            n_rings += 1
        first = last
    return vertices[:count], ends[:n_rings]


@njit(cache=True)
def _trace(filled, n_cells):
    """Rings around the filled cells, corners only: vertices (V, 2) and the end of every ring. Every side of a filled
    cell is walked once with the cell on its left; the direction of a walk is 0: +j, 1: -i, 2: -j, 3: +i. The first ring
    found is the shell of a part."""
    n_i, n_j = filled.shape
    seen = np.zeros((n_i, n_j), dtype=np.bool_)  # sides walked in direction 2, of which every ring has one
    vertices = np.empty((4 * n_cells + 1, 2))
    ends = np.empty(4 * n_cells + 1, dtype=np.int64)
    n_vertices, n_rings = 0, 0
    for i0 in range(1, n_i - 1):
        for j0 in range(1, n_j - 1):
            if not filled[i0, j0] or filled[i0 - 1, j0] or seen[i0, j0]:
                continue
            i, j, d = i0, j0, 2
            while d != 2 or not seen[i, j]:
                if d == 2:
                    seen[i, j] = True
                a, b = i + (d == 3) - (d == 1), j + (d == 0) - (d == 2)
                right = (d + 3) % 4
                c, e = a + (right == 3) - (right == 1), b + (right == 0) - (right == 2)
                if not filled[a, b] or filled[c, e]:  # a corner, at the end of the side
                    vertices[n_vertices, 0], vertices[n_vertices, 1] = i + (d == 0 or d == 3), j + (d < 2)
                    n_vertices += 1
                if not filled[a, b]:
                    d = (d + 1) % 4
                elif filled[c, e]:
                    i, j, d = c, e, right
                else:
                    i, j = a, b
            ends[n_rings] = n_vertices
            n_rings += 1
    return vertices[:n_vertices], ends[:n_rings]


@inlined
def _simplify(ring, kept):
    """Mark the vertices of a ring (V, 2) that Douglas and Peucker's algorithm keeps, to 0.75 cells; how many."""
    n = ring.shape[0]
    far, best = 0, -1.0
    for k in range(n):
        kept[k] = False
        distance = (ring[k, 0] - ring[0, 0]) ** 2 + (ring[k, 1] - ring[0, 1]) ** 2
        if distance > best:
            far, best = k, distance
    kept[0], kept[far] = True, True
    stack = np.empty((n + 2, 2), dtype=np.int64)
    stack[0, 0], stack[0, 1], stack[1, 0], stack[1, 1] = 0, far, far, n
    top, count = 2, 2
    while top > 0:
        top -= 1
        first, last = stack[top, 0], stack[top, 1]
        middle, best = -1, 0.75 * 0.75
        for k in range(first + 1, last):
            distance = _from_segment(ring[k], ring[first], ring[last % n])
            if distance > best:
                middle, best = k, distance
        if middle >= 0:
            kept[middle] = True
            count += 1
            stack[top, 0], stack[top, 1], stack[top + 1, 0], stack[top + 1, 1] = first, middle, middle, last
            top += 2
    return count


@inlined
def _from_segment(p, a, b):
    """Squared distance of a point from a segment."""
    ux, uy, vx, vy = b[0] - a[0], b[1] - a[1], p[0] - a[0], p[1] - a[1]
    length = ux * ux + uy * uy
    along = 0.0 if length == 0.0 else min(1.0, max(0.0, (ux * vx + uy * vy) / length))
    return (vx - along * ux) ** 2 + (vy - along * uy) ** 2
