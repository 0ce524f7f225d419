"""Kernels of rasters: what beams found occupied and free, and how well points lie on it under many motions."""

from __future__ import annotations

import numpy as np

from spplanes._jit import njit


@njit(cache=True)
def mark(beams, origin, cell, margin, hits, passes):
    """Count into `hits` and `passes` (H, W) the returns, and beams that pass more than `margin` before their return.

    A beam is a row (x0, y0, x1, y1), from the sensor to its return; `origin` is the corner of cell (0, 0).
    """
    for k in range(beams.shape[0]):
        x0, y0 = (beams[k, 0] - origin[0]) / cell, (beams[k, 1] - origin[1]) / cell
        x1, y1 = (beams[k, 2] - origin[0]) / cell, (beams[k, 3] - origin[1]) / cell
        hits[int(y1), int(x1)] += 1
        length = np.hypot(x1 - x0, y1 - y0)
        last_row, last_column = -1, -1
        for step in range(int(max(length - margin / cell, 0.0))):
            share = step / length
            row, column = int(y0 + share * (y1 - y0)), int(x0 + share * (x1 - x0))
            if row != last_row or column != last_column:
                passes[row, column] += 1
                last_row, last_column = row, column


@njit(cache=True)
def squared_distances(hits, reach):
    """Squared distance, in cells, of every cell to the nearest with a hit; 2 reach^2 + 1 beyond `reach`, (H, W)."""
    rows, columns = hits.shape
    result = np.full((rows, columns), 2 * reach * reach + 1, np.int64)
    for r in range(rows):
        for c in range(columns):
            if hits[r, c] == 0:
                continue
            for i in range(max(r - reach, 0), min(r + reach + 1, rows)):
                for j in range(max(c - reach, 0), min(c + reach + 1, columns)):
                    result[i, j] = min(result[i, j], (i - r) ** 2 + (j - c) ** 2)
    return result


@njit(cache=True)
def score_motions(motions, cell, a, b):
    """Mean over both ways of the weighted sum under b_T_a = (x, y, theta), (M,): points of raster a in b, and back."""
    result = np.empty(motions.shape[0])
    rows, columns = b.table.shape
    other_rows, other_columns = a.table.shape
    for m in range(motions.shape[0]):
        x, y, theta = motions[m, 0], motions[m, 1], motions[m, 2]
        c, s = np.cos(theta), np.sin(theta)
        there = back = 0.0
        for k in range(a.points.shape[0]):
            u = c * a.points[k, 0] - s * a.points[k, 1] + x - b.origin[0]
            v = s * a.points[k, 0] + c * a.points[k, 1] + y - b.origin[1]
            column, row = int(np.floor(u / cell)), int(np.floor(v / cell))
            if 0 <= column < columns and 0 <= row < rows:
                there += b.table[row, column]
        for k in range(b.points.shape[0]):
            dx, dy = b.points[k, 0] - x, b.points[k, 1] - y
            u, v = c * dx + s * dy - a.origin[0], c * dy - s * dx - a.origin[1]
            column, row = int(np.floor(u / cell)), int(np.floor(v / cell))
            if 0 <= column < other_columns and 0 <= row < other_rows:
                back += a.table[row, column]
        result[m] = 0.5 * (a.weight * there + b.weight * back)
    return result
