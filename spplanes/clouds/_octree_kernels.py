"""Kernels of `spplanes.clouds.octree`: cells are runs of points along a Morton curve."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner, njit
from spplanes.fitting._moment_patches import add_run, centre_sums, eigenvalues, normal_of
from spplanes.moments import ROW_SIZE

#: Bits of a place along each axis: the finest cells are a millionth of the cloud.
LEVELS = 20
#: The noise of points is that about a plane through so many neighbours; it has the shared error up to that scale in it.
LOCAL = 48


@inner(cache=True)
def run_moments(points, variances, first, last, weighted, row):
    """Moments of the points from first to last, (1, N, 3), by their variances (1, N, 1) where they are weighted."""
    row[:] = 0.0
    about = points[0, first]
    add_run(row, points, variances, 0, first, last, about, about, 0.0, weighted)  # isotropic: along any normal
    centre_sums(row, about)


@inner(cache=True)
def octant_end(keys, first, last, shift):
    """Where the run of points ends that share the octant of the first."""
    octant, end = keys[first] >> shift, first + 1
    while end < last and keys[end] >> shift == octant:
        end += 1
    return end


@inner(cache=True)
def push_octants(keys, first, last, level, stack, top):
    """Put the octants of a cell (first point, last, level) on a stack; how many cells are on it then."""
    while first < last:
        end = octant_end(keys, first, last, 3 * (LEVELS - level - 1))
        stack[top, 0], stack[top, 1], stack[top, 2] = first, end, level + 1
        first, top = end, top + 1
    return top


@njit(cache=True)
def largest_cells(keys, most):
    """First point, and where the last one ends, of the largest cells of at most so many points, shape (K, 2)."""
    cells, count = np.empty((keys.shape[0], 2), np.int64), 0
    stack, top = np.empty((8 * LEVELS + 8, 3), np.int64), min(keys.shape[0], 1)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, keys.shape[0], 0
    while top > 0:
        top -= 1
        first, last, level = stack[top, 0], stack[top, 1], stack[top, 2]
        if last - first <= most or level == LEVELS:
            cells[count, 0], cells[count, 1] = first, last
            count += 1
            continue
        top = push_octants(keys, first, last, level, stack, top)
    return cells[:count].copy()


@njit(cache=True)
def local_scatter(points, cells):
    """(n, least, middle eigenvalue of the scatter, first point) of every cell, (K, 2), shape (K, 4)."""
    result, row = np.empty((cells.shape[0], 4)), np.empty(ROW_SIZE)
    grid, none = points.reshape(1, -1, 3), np.empty((1, 0, 1))
    for k in range(cells.shape[0]):
        run_moments(grid, none, cells[k, 0], cells[k, 1], False, row)
        least, middle, _ = eigenvalues(row)
        result[k, 0], result[k, 1], result[k, 2], result[k, 3] = row[0], least, middle, cells[k, 0]
    return result


@njit(cache=True)
def planar_leaves(points, keys, variances, octave, fewest, limits):
    """Leaves (first point, level, planar) along the curve, shape (C, 3), and their moments, (C, 11); see `Cells.of`.

    `limits` are normal quantile and slack of the residuals of a cell, largest chi2 of an octant's offset, least
    information on a tilt, 1 / rad^2; `octave` is the variance of the shared error of an octave, m^2, `fewest` points
    are judged.
    """
    cells, rows, count = np.empty((points.shape[0], 3), np.int64), np.empty((points.shape[0], ROW_SIZE)), 0
    stack, top = np.empty((8 * LEVELS + 8, 3), np.int64), min(points.shape[0], 1)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, points.shape[0], 0
    weights, grid, noise = 1.0 / variances, points.reshape(1, -1, 3), variances.reshape(1, -1, 1)
    while top > 0:
        top -= 1
        first, last, level = stack[top, 0], stack[top, 1], stack[top, 2]
        run_moments(grid, noise, first, last, True, rows[count])
        shift = 3 * (LEVELS - level - 1)
        run = first, last, shift
        planar = last - first >= fewest and is_planar(points, keys, weights, octave, run, rows[count], limits)
        if planar or last - first < fewest or level == LEVELS:
            cells[count, 0], cells[count, 1], cells[count, 2] = first, level, planar
            count += 1
            continue
        begin = top
        top = push_octants(keys, first, last, level, stack, top)
        for k in range((top - begin) // 2):  # so that the first is taken first
            for m in range(3):
                a, b = begin + k, top - 1 - k
                stack[a, m], stack[b, m] = stack[b, m], stack[a, m]
    return cells[:count].copy(), rows[:count].copy()


@inlined
def is_planar(points, keys, weights, octave, run, row, limits):
    """Whether the points of a cell fit one plane and determine it; see `Cells.of`."""
    first, last, shift = run
    dof = row[0] - 3.0
    spread = 2.0 / (9.0 * dof)
    least, middle, _ = eigenvalues(row)
    octaves = max(0.5 * np.log2(row[0] / LOCAL), 0.0)  # between the extent of the cell and that in which noise is found
    slack = limits[1] * (1.0 + octave * row[1] / row[0] * octaves)
    if least > slack * dof * (1.0 - spread + limits[0] * np.sqrt(spread)) ** 3 or middle - row[0] < limits[3]:
        return False
    nx, ny, nz = normal_of(row, least)
    while shift >= 0 and first < last:
        end = octant_end(keys, first, last, shift)
        total = mean = 0.0
        for k in range(first, end):
            x, y, z = points[k, 0] - row[2], points[k, 1] - row[3], points[k, 2] - row[4]
            total += weights[k]
            mean += weights[k] * (x * nx + y * ny + z * nz)
        if mean * mean > limits[2] * (total + octave * total * total):
            return False
        first = end
    return True
