"""Where a surface bends: local normals that contradict a region's plane part regions that are coplanar by chance.

Two cushions in one plane with a seam between are two planes; every point of the seam lies within the tolerance of their
common plane, but the surface there is turned. Where noise drowns the local normal, the test stays silent.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import ndimage

from spplanes._jit import inlined, njit
from spplanes._threads import in_parts
from spplanes.fitting._moment_patches import distance_of, variance_from


def unlabel_creases(grid, planes, max_angle, certainty):
    """Unlabel, in place, the points whose local normal is turned from that of their region.

    The local normal is that of the differences between means of six points, right minus left and below minus above, in
    a window of five by five; it is only judged where all of them are returns. It must exceed `max_angle`, rad, which a
    plane's surface may have anyway, by `certainty` of its standard deviations.
    """
    _, _, _, labels, start = grid
    top = max(start, 2)
    in_parts(partial(_unlabel_in, grid, planes, max_angle, certainty, top), len(labels) - 2 - top, labels.size)


@njit(cache=True)
def _unlabel_in(grid, planes, max_angle, certainty, top, first, last):
    """The same in the rows from first to last, counted from the top one."""
    points, covariance, valid, labels, _ = grid
    first, last, n_cols = top + first, top + last, labels.shape[1]
    across, down, full = _differences(points[first - 2 : last + 2], valid[first - 2 : last + 2])
    u, v = np.empty(3), np.empty(3)
    cosine_limit = np.cos(max_angle)
    for i in range(first, last):
        a = i - first + 2
        for j in range(2, n_cols - 2):
            r = labels[i, j]
            if r < 0 or not full[a, j]:
                continue
            for k in range(3):
                u[k] = across[a - 1, j, k] + across[a, j, k] + across[a + 1, j, k]
                v[k] = down[a, j - 1, k] + down[a, j, k] + down[a, j + 1, k]
            nx, ny, nz = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
            square = nx * nx + ny * ny + nz * nz
            turned = abs(nx * planes[r, 0] + ny * planes[r, 1] + nz * planes[r, 2])
            if square == 0.0 or turned * turned >= cosine_limit * cosine_limit * square:
                continue
            length = np.sqrt(square)
            shorter = length / np.sqrt(max(u[0] ** 2 + u[1] ** 2 + u[2] ** 2, v[0] ** 2 + v[1] ** 2 + v[2] ** 2))
            noise = np.sqrt(variance_from(covariance, i, j, planes, r) * 12.0)
            if np.arccos(turned / length) > max_angle + certainty * noise / shorter:
                labels[i, j] = -1


@inlined
def _differences(points, valid):
    """Right minus left and below minus above, two points each, (S, B, 3), and whether the five by five are returns."""
    n_rows, n_cols = valid.shape
    across, down = np.empty(points.shape), np.empty(points.shape)
    five, full = np.zeros(valid.shape, dtype=np.bool_), np.zeros(valid.shape, dtype=np.bool_)
    for i in range(n_rows):
        for j in range(2, n_cols - 2):
            five[i, j] = valid[i, j - 2] & valid[i, j - 1] & valid[i, j] & valid[i, j + 1] & valid[i, j + 2]
            for k in range(3):
                across[i, j, k] = points[i, j + 1, k] + points[i, j + 2, k] - points[i, j - 1, k] - points[i, j - 2, k]
    for i in range(2, n_rows - 2):
        for j in range(n_cols):
            full[i, j] = five[i - 2, j] & five[i - 1, j] & five[i, j] & five[i + 1, j] & five[i + 2, j]
            for k in range(3):
                down[i, j, k] = points[i + 1, j, k] + points[i + 2, j, k] - points[i - 1, j, k] - points[i - 2, j, k]
    return across, down, full


def unlabel_seams(grid, views, planes, tolerance, flatness, reach, limit):
    """Unlabel, in place, the points around which a region's points lie behind its plane on average (chi2, 1 dof).

    A seam between two cushions is a groove of millimetres, less than the noise of a point but not than that of the mean
    in a window, which reaches `reach` points to each side and may have the variance `tolerance` (R,), m^2, beside its
    noise. Where it parts a region, there are two; where it does not, the region grows over it again. Where surfaces are
    granted more than the noise (`flatness`, m), nothing hides in it, and what shows are the surfaces' own waves.
    """
    labels, start = grid[3:]
    variance, distance = np.full(labels.shape, np.inf), np.zeros(labels.shape)
    in_parts(partial(_measure_rows, grid, planes, variance, distance), len(labels) - start, labels.size)
    weight, moment = (
        _sums_along(_sums_along(one, labels, reach).T.copy(), labels.T.copy(), reach).T
        for one in (1.0 / variance, 1.0 / variance * distance)
    )
    x, y, z, d = np.moveaxis(planes[labels], -1, 0)
    eye = views[:, :1] * x + views[:, 1:2] * y + views[:, 2:] * z - d
    shows = (variance > flatness * flatness) & (moment**2 > limit * weight * (1.0 + tolerance[labels] * weight))
    labels[shows & (moment * eye < 0.0)] = -1


@njit(cache=True)
def _measure_rows(grid, planes, variance, distance, first, last):
    """Distances of the points in the fresh rows from first to last from their planes, and their variances, in place."""
    points, covariance, _, labels, start = grid
    for i in range(start + first, start + last):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r >= 0:
                variance[i, j] = variance_from(covariance, i, j, planes, r)
                distance[i, j] = distance_of(points, i, j, planes, r)


@njit(cache=True)
def _sums_along(values, labels, reach):
    """Sums of the values within reach along every row that lie in the same run of equal labels; 0 of no region."""
    n_rows, n_cols = values.shape
    result = np.zeros(values.shape)
    for i in range(n_rows):
        end = 0
        while end < n_cols:
            begin, r = end, labels[i, end]
            while end < n_cols and labels[i, end] == r:
                end += 1
            if r < 0:
                continue
            total = 0.0
            for j in range(begin, min(begin + reach, end)):
                total += values[i, j]
            for j in range(begin, end):
                if j + reach < end:
                    total += values[i, j + reach]
                if j - reach - 1 >= begin:
                    total -= values[i, j - reach - 1]
                result[i, j] = total
    return result


def split_regions(labels: np.ndarray, start: int, n_regions: int) -> np.ndarray:
    """Give every connected part of a region, in place, a number of its own: the first n_regions are kept for those. The
    part of a region that the rows before `start` hold keeps its number, all other parts but the first get new ones. The
    region that every new number was part of is returned, shape (K,)."""
    links = np.zeros(2 * np.array(labels.shape) - 1, dtype=bool)  # of points, and between those of one region
    links[::2, ::2] = labels >= 0
    links[::2, 1::2] = (labels[:, 1:] >= 0) & (labels[:, 1:] == labels[:, :-1])
    links[1::2, ::2] = (labels[1:] >= 0) & (labels[1:] == labels[:-1])
    parts, count = ndimage.label(links)  # type: ignore[misc]  # numbered in the order of their first points
    part_of = parts[::2, ::2]
    first = np.full(count + 1, labels.size)
    np.minimum.at(first, part_of.ravel(), np.arange(labels.size))
    old = labels.ravel()[first[1:]]
    settled = first[1:] < start * labels.shape[1]
    known = settled.copy()
    known[np.unique(old, return_index=True)[1]] = True
    number = np.where(known, old, n_regions - 1 + np.cumsum(~known))
    labels[:] = np.append(-1, number)[part_of]
    return old[~known]
