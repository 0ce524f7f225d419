"""Steps inside planar cells: two parallel planes, little more than their noise apart, that pass for one."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inner, njit
from spplanes._rows import solve3
from spplanes._threads import in_parts
from spplanes.fitting._moment_patches import eigenvalues, normal_of, variance_along

#: Strips into which a cell is cut, along rows and along columns, in search of a step.
STRIPS = 8
#: Share of the variance of flatness that a step inside a cell may have: surfaces wander over metres, not at once.
STEP_SHARE = 0.1


def reject_steps(planar, cells, rows, limit):
    """Take from the planar cells, in place, those with a step along some row or column of the grid (chi2).

    A step of little more than the noise hides in the residuals of a cell's points, most of all when the plane tilts to
    meet both sides. Residuals are explained by place in the grid, linearly, and by the step: unlike coordinates, places
    have no noise, which along slanted beams goes together with that of the residuals.

    Args:
        planar: planar cells, shape (R, C) bool.
        cells: the arguments of `cells.cell_moments`.
        rows: what it returned.
        limit: largest chi2 (1 dof) of a step, the largest of all.
    """

    def some(first: int, last: int) -> None:
        _reject_in(planar, cells, rows, limit, first, last)

    in_parts(some, len(planar), cells[3] ** 2 * int(planar.sum()))


@njit(cache=True)
def _reject_in(planar, cells, rows, limit, first, last):
    """Take them from the rows of cells from first to last."""
    points, covariance, free, size, floor_variance = cells
    side, tolerance = size // STRIPS, STEP_SHARE * floor_variance
    strips, total = np.empty((2, STRIPS, 4)), np.empty(5)
    for ci in range(first, last):
        for cj in range(rows.shape[1]):
            if not planar[ci, cj]:
                continue
            row = rows[ci, cj]
            nx, ny, nz = normal_of(row, eigenvalues(row)[0])
            d = nx * row[2] + ny * row[3] + nz * row[4]
            strips[:], total[:] = 0.0, 0.0
            for i in range(ci * size, min((ci + 1) * size, points.shape[0])):
                for j in range(cj * size, min((cj + 1) * size, points.shape[1])):
                    if not free[i, j]:
                        continue
                    w = 1.0 / (variance_along(covariance, i, j, nx, ny, nz) + floor_variance)
                    r = w * (points[i, j, 0] * nx + points[i, j, 1] * ny + points[i, j, 2] * nz - d)
                    u, v = i - ci * size, j - cj * size
                    for along in range(2):
                        k = u // side if along == 0 else v // side
                        strips[along, k, 0] += w
                        strips[along, k, 1] += w * u
                        strips[along, k, 2] += w * v
                        strips[along, k, 3] += r
                    total[0] += w * u * u
                    total[1] += w * u * v
                    total[2] += w * v * v
                    total[3] += r * u
                    total[4] += r * v
            chi2 = max(_step_chi2(strips[0], total, tolerance), _step_chi2(strips[1], total, tolerance))
            planar[ci, cj] = chi2 <= limit


@inner(cache=True)
def _step_chi2(strips, total, tolerance):
    """Largest chi2 (1 dof) of a step between strips, beside a linear trend: weighted regression, step by step.

    Args:
        strips: sums of w, w u, w v, w r of every strip, shape (STRIPS, 4).
        total: sums of w u u, w u v, w v v, w r u, w r v of all.
        tolerance: variance that a step may have anyway, m^2.
    """
    w = u = v = r = 0.0
    for k in range(strips.shape[0]):
        w, u, v, r = w + strips[k, 0], u + strips[k, 1], v + strips[k, 2], r + strips[k, 3]
    least, best = 1e-6 * w, 0.0  # a cell of one row has no trend across rows
    matrix = (w + least, u, v, total[0] + least, total[1], total[2] + least)
    trend = solve3(matrix, r, total[3], total[4])
    bw = bu = bv = br = 0.0
    for k in range(strips.shape[0] - 1, 0, -1):
        bw, bu, bv, br = bw + strips[k, 0], bu + strips[k, 1], bv + strips[k, 2], br + strips[k, 3]
        if bw == 0.0 or bw == w:
            continue
        solved = solve3(matrix, bw, bu, bv)
        share = bw - (bw * solved[0] + bu * solved[1] + bv * solved[2])
        if share > 1e-3 * w:
            step = (br - (bw * trend[0] + bu * trend[1] + bv * trend[2])) / share
            best = max(best, step * step / (1.0 / share + tolerance))
    return best
