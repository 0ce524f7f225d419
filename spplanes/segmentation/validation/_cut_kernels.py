"""Where the points of a measured plane part best into two: regression on place, scan and step."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, njit

#: Fewest points on either side of a cut.
FEWEST = 6
#: Bands of beams between which the corners of a surface are sought; straight cuts are sought from beam to beam.
BANDS = 24
#: Chi2 by which a corner must be surer than a straight cut: there are forty times as many of them, and 2 log 40 is 7.4.
CORNER = 7.4


def best_cut(row, column, place, residuals, weights, drift, uneven, least):
    """The set of points that is stepped most surely from the others, and the chi2 (1 dof) of its step.

    Residuals are explained by a plane, by an offset of every scan, and by a step between the two sets. Sets are parted
    between two scans, between two beams, or have a corner of the grid to themselves; chi2 of these is less `CORNER`.

    Args:
        row, column: scan and beam of every point, shape (N,), from 0 on.
        place: places on the plane, (N, 2), m; their noise must not go with that of the residuals.
        residuals, weights: along the normal, shape (N,), m and 1 / m^2.
        drift: information (S, S) of the offsets of the scans along the normal, 1 / m^2.
        uneven: variance of a step on one plane, for surfaces are not flat, m^2.
        least: smaller steps are none, m.

    Returns:
        Which points are beyond the best cut, shape (N,) bool, and its chi2; 0 where there is none to be judged.
    """
    inverse, left = _explained(row, place, residuals, weights, drift)
    n_columns = int(column.max()) + 1
    (i0, i1, j0, j1), chi2 = _surest(row, column, place, left, weights, inverse, n_columns, uneven, least)
    return (row >= i0) & (row < i1) & (column >= j0) & (column < j1), chi2


@njit(cache=True)
def _surest(row, column, place, left, weights, inverse, n_columns, uneven, least):
    """Scans and beams, from and to, of the surest step that is left, and its chi2; see `best_cut`."""
    n_rows = inverse.shape[0] - 3
    sums = np.zeros((n_rows, n_columns + 1, 5))
    for k in range(row.shape[0]):
        cell, w = sums[row[k], column[k] + 1], weights[k]
        cell[0] += w
        cell[1] += w * place[k, 0]
        cell[2] += w * place[k, 1]
        cell[3] += w * left[k]
        cell[4] += 1.0
    for i in range(n_rows):
        for j in range(n_columns):
            for k in range(5):
                sums[i, j + 1, k] += sums[i, j, k]
    best, cut = 0.0, (0, n_rows, 0, 0)
    every = max(n_columns // BANDS, 1)
    z = np.empty(3 + n_rows)
    for a in range(n_rows):
        for b in range(1, n_columns + 1):
            straight = a == 0 or b == n_columns
            if not straight and b % every != 0:
                continue
            for corner in range(1 if straight else 4):
                i0, i1 = (a, n_rows) if corner % 2 == 0 else (0, a)
                j0, j1 = (0, b) if corner < 2 else (b, n_columns)
                chi2 = _step(sums, i0, i1, j0, j1, inverse, uneven, least, z) - (0.0 if straight else CORNER)
                if chi2 > best:
                    best, cut = chi2, (i0, i1, j0, j1)
    return cut, best


def _explained(row, place, residuals, weights, drift):
    """Covariance of plane and offsets of scans, (3 + S, 3 + S), and what they leave of the residuals, shape (N,)."""
    shape = np.column_stack((np.ones(len(row)), place))
    weighted = weights[:, None] * shape
    of_scans = np.array([np.bincount(row, column, len(drift)) for column in weighted.T])
    matrix = np.block([[weighted.T @ shape, of_scans], [of_scans.T, drift + np.diag(of_scans[0])]])
    matrix[np.diag_indices_from(matrix)] *= 1.0 + 1e-9  # points of one line do not tell a tilt
    inverse = np.linalg.inv(matrix)
    right = np.concatenate((weighted.T @ residuals, np.bincount(row, weights * residuals, len(drift))))
    found = inverse @ right
    return inverse, residuals - shape @ found[:3] - found[3 + row]


@inlined
def _step(sums, i0, i1, j0, j1, inverse, uneven, least, z):
    """Chi2 of the step of the points in scans i0 to i1 and beams j0 to j1, from sums over beams before."""
    z[:] = 0.0
    moment, count, total = 0.0, 0.0, 0.0
    for i in range(sums.shape[0]):
        total += sums[i, -1, 4]
    for i in range(i0, i1):
        for k in range(3):
            z[k] += sums[i, j1, k] - sums[i, j0, k]
        z[3 + i] = sums[i, j1, 0] - sums[i, j0, 0]
        moment += sums[i, j1, 3] - sums[i, j0, 3]
        count += sums[i, j1, 4] - sums[i, j0, 4]
    if count < FEWEST or total - count < FEWEST:
        return 0.0
    share = z[0]
    for a in range(z.shape[0]):
        if z[a] != 0.0:
            explained = 0.0
            for b in range(z.shape[0]):
                explained += inverse[a, b] * z[b]
            share -= z[a] * explained
    if share <= 1e-6 * z[0]:
        return 0.0
    step = moment / share
    return step * step / (1.0 / share + uneven) if abs(step) >= least else 0.0
