"""Noise estimation: how much a scanner's ranges scatter, read off a cloud, for sensors nobody describes."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import njit

#: Neighbours lie within this share of each other's range: one surface, not an edge.
_SAME_SURFACE = 0.05
#: The wider of two steps between beams is less than so many times the narrower, as chords.
_EVEN = 2.5


def misses_of(grid: FloatArray, lag: int = 1, *, closed: bool = False) -> FloatArray:
    """How far the middle of three beams in a row lies from the plane through the outer two, shape (S, B - 2 lag), m.

    On a plane, inverse ranges of three beams a, b and c in a row are linear in the sines of the angles between them,
    sin(ac) / r_b = sin(bc) / r_a + sin(ab) / r_c, whatever the plane. What b misses that by is the noise of three
    beams; it is scaled to that of one. NaN where the three are not all there, not evenly spaced, or not at similar
    ranges. In closed rows the first beam follows the last; then there is a value for every beam, shape (S, B).
    """
    return _misses(np.ascontiguousarray(grid), lag, closed)


@njit(cache=True)
def _misses(grid, lag, closed):
    """See `misses_of`. Of the angle under a chord c between rays, sin = c sqrt(1 - c^2 / 4) and cos = 1 - c^2 / 2."""
    n_rows, n_columns = grid.shape[:2]
    first = 0 if closed else lag
    width = max(n_columns - 2 * first, 0)
    missed = np.empty((n_rows, width))
    ranges = np.empty(n_columns)
    for i in range(n_rows):
        for j in range(n_columns):
            ranges[j] = np.sqrt(grid[i, j, 0] ** 2 + grid[i, j, 1] ** 2 + grid[i, j, 2] ** 2)
        for j in range(width):
            missed[i, j], at = np.nan, j + first
            left, right = (at - lag) % n_columns, (at + lag) % n_columns
            a, b, c = ranges[left], ranges[at], ranges[right]
            if not (max(abs(a - b), abs(c - b)) < _SAME_SURFACE * b):
                continue
            ab, bc = 0.0, 0.0
            for k in range(3):
                ray = grid[i, at, k] / b
                ab += (ray - grid[i, left, k] / a) ** 2
                bc += (ray - grid[i, right, k] / c) ** 2
            if not (ab > 0.0 and bc > 0.0 and ab < 4.0 and bc < 4.0 and max(ab, bc) < _EVEN**2 * min(ab, bc)):
                continue
            sin_ab, sin_bc = np.sqrt(ab * (1.0 - 0.25 * ab)), np.sqrt(bc * (1.0 - 0.25 * bc))
            whole = sin_ab * (1.0 - 0.5 * bc) + (1.0 - 0.5 * ab) * sin_bc
            expected = whole / (sin_bc / a + sin_ab / c)
            slope_a, slope_c = expected**2 * sin_bc / (whole * a**2), expected**2 * sin_ab / (whole * c**2)
            missed[i, j] = (b - expected) / np.sqrt(1.0 + slope_a**2 + slope_c**2)
    return missed
