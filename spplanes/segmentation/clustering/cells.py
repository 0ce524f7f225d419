"""Square cells of an organised grid: moments, planarity, steps inside of them, and neighbourhood."""

from __future__ import annotations

from functools import partial

import numpy as np

from spplanes._jit import inlined, inner, njit
from spplanes._rows import solve3
from spplanes._threads import in_parts
from spplanes.fitting._moment_patches import add_run, centre_sums, eigenvalues, normal_of, variance_along
from spplanes.moments import ROW_SIZE

#: Strips into which a cell is cut, along rows and along columns, in search of a step.
STRIPS = 8
#: Share of the variance of flatness that a step inside a cell may have: surfaces wander over metres, not at once.
STEP_SHARE = 0.1


def cell_moments(points, covariance, free, size, floor_variance):
    """Moments (R, C, 11) of the free points, (S, B) bool, of every cell that is filled, a square of `size` points,
    weighted along its own normal; `floor_variance`, m^2, is added to the variance of every point."""
    n_rows, n_cols = (points.shape[0] + size - 1) // size, (points.shape[1] + size - 1) // size
    rows = np.zeros((n_rows, n_cols, ROW_SIZE))
    in_parts(partial(_moments_of, rows, (points, covariance, free, size, floor_variance)), n_rows, free.size)
    return rows


@njit(cache=True)
def _moments_of(rows, cells, first, last):
    """The moments of the rows of cells from first to last; `cells` are the arguments of `cell_moments`."""
    _, _, free, size, _ = cells
    counts = np.empty(rows.shape[1], dtype=np.int64)
    for ci in range(first, last):
        for cj in range(rows.shape[1]):
            counts[cj] = 0
        for i in range(ci * size, min((ci + 1) * size, free.shape[0])):
            for cj in range(rows.shape[1]):
                for j in range(cj * size, min((cj + 1) * size, free.shape[1])):
                    counts[cj] += free[i, j]
        for cj in range(rows.shape[1]):
            area = min(size, free.shape[0] - ci * size) * min(size, free.shape[1] - cj * size)
            if counts[cj] >= max(0.4 * area, 4.0):
                _one_cell(rows[ci, cj], cells, ci * size, cj * size)


@inlined
def _one_cell(row, cells, i0, j0):
    points, covariance, free, size, floor_variance = cells
    i1, j1 = min(i0 + size, points.shape[0]), min(j0 + size, points.shape[1])
    about, normal, isotropic = np.zeros(3), np.zeros(3), covariance.shape[2] == 1
    normal[2] = 1.0
    for last in (False, True):
        if not last and isotropic:
            continue
        for k in range(ROW_SIZE):
            row[k] = 0.0
        for i in range(i0, i1):
            j = j0
            while j < j1:
                begin = j
                while j < j1 and free[i, j]:
                    j += 1
                if j > begin:
                    if row[0] == 0.0:
                        about[0], about[1], about[2] = points[i, begin, 0], points[i, begin, 1], points[i, begin, 2]
                    add_run(row, points, covariance, i, begin, j, about, normal, floor_variance, last)
                j += 1  # past what is not free
        if row[0] == 0.0:
            return
        centre_sums(row, about)
        if not last:
            normal[0], normal[1], normal[2] = normal_of(row, eigenvalues(row)[0])


def failed_quads(free, quads, size):
    """Number of quads between free points inside every cell that the filter threw away, shape (R, C)."""
    failed = np.zeros(free.shape, dtype=np.int64)
    failed[:-1, :-1] = ~quads & free[:-1, :-1] & free[:-1, 1:] & free[1:, :-1] & free[1:, 1:]
    failed[size - 1 :: size] = failed[:, size - 1 :: size] = 0  # these reach into the next cell
    of_rows = np.add.reduceat(failed, np.arange(0, free.shape[0], size), axis=0)
    return np.add.reduceat(of_rows, np.arange(0, free.shape[1], size), axis=1)


@njit(cache=True)
def planar_cells(rows, failed, size, quantile, slack):
    """Cells whose points fit one plane: filled, without jumps, residuals as noise explains; shape (R, C) bool."""
    planar = np.zeros(rows.shape[:2], dtype=np.bool_)
    for ci in range(rows.shape[0]):
        for cj in range(rows.shape[1]):
            row = rows[ci, cj]
            dof = row[0] - 3.0
            if row[0] == 0.0 or failed[ci, cj] > size // 2:
                continue
            spread = 2.0 / (9.0 * dof)
            limit = slack * dof * (1.0 - spread + quantile * np.sqrt(spread)) ** 3
            planar[ci, cj] = eigenvalues(row)[0] <= limit
    return planar


def reject_steps(planar, cells, rows, limit):
    """Take from the planar cells, (R, C) bool, in place, those with a step along some row or column of the grid (chi2).

    A step of little more than the noise hides in the residuals of a cell's points, most of all when the plane tilts to
    meet both sides. Residuals are explained by place in the grid, linearly, and by the step: unlike coordinates, places
    have no noise, which along slanted beams goes together with that of the residuals. `cells` and `rows` are the
    arguments of `cell_moments` and what it returned.
    """
    in_parts(partial(_reject_in, planar, cells, rows, limit), len(planar), cells[3] ** 2 * int(planar.sum()))


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
    """Largest chi2 (1 dof) of a step between strips, beside a linear trend: weighted regression, step by step. Of
    `strips` sums of w, w u, w v, w r each, (STRIPS, 4), of all `total` w u u, w u v, w v v, w r u, w r v; a step may
    have the variance `tolerance`, m^2, anyway."""
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


@njit(cache=True)
def shared_variances(rows, shared, free, planar, size, start):
    """Of planar cells: mean variance along the normal that points share with their scans, and mean scan, (K, 2)."""
    result, count = np.zeros((planar.size, 2)), 0
    for ci in range(rows.shape[0]):
        for cj in range(rows.shape[1]):
            if not planar[ci, cj]:
                continue
            result[count, 1] = start + (ci + 0.5) * size
            nx, ny, nz = normal_of(rows[ci, cj], eigenvalues(rows[ci, cj])[0])
            if shared.shape[0] > 1:
                for i in range(ci * size, min((ci + 1) * size, free.shape[0])):
                    for j in range(cj * size, min((cj + 1) * size, free.shape[1])):
                        if free[i, j]:
                            result[count, 0] += variance_along(shared, i, j, nx, ny, nz) / rows[ci, cj, 0]
            count += 1
    return result[:count]


def cell_edges(node: np.ndarray, labels: np.ndarray, start: int, size: int) -> np.ndarray:
    """Pairs (E, 2) of neighbouring nodes: cells beside cells, and cells beside regions labelled already. Planar cells
    have the numbers `node`, (R, C), -1 = none, after those of regions; they begin at row `start` of the labels."""
    n_rows, n_cols = size * np.array(node.shape)
    around = np.full((n_rows + 2, n_cols + 2), -1)  # a frame of points, and what cells lack at the ends
    around[start == 0 : 1 + len(labels) - start, 1 : 1 + labels.shape[1]] = labels[max(start - 1, 0) :]
    i, j = np.nonzero(node >= 0)
    me, beyond = node[i, j], np.pad(node, (0, 1), constant_values=-1)
    top, left, inside = size * i[:, None], size * j[:, None], np.arange(1, size + 1)
    frame = around[top, left + inside], around[top + size + 1, left + inside]
    frame += around[top + inside, left], around[top + inside, left + size + 1]
    beside = np.column_stack((beyond[i, j + 1], beyond[i + 1, j], *frame))
    there = beside >= 0
    there[:, 1:] &= beside[:, 1:] != beside[:, :-1]  # runs are counted once
    one, other = np.repeat(me, there.sum(axis=1)), beside[there]
    return np.stack((np.minimum(one, other), np.maximum(one, other)), axis=1)
