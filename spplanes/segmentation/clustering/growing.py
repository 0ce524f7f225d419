"""Regions grow over the points around them, are fitted again, and fuse where a chi2 test says they are one plane."""

from __future__ import annotations

from functools import partial

import numpy as np

from spplanes._jit import njit
from spplanes._threads import in_parts, threads_for
from spplanes.fitting._moment_patches import (
    add_run,
    centre_sums,
    distance_of,
    eigenvalues,
    normal_of,
    residual_chi2,
    variance_from,
)
from spplanes.moments import merge_rows


@njit(cache=True)
def hesse(rows):
    """(normal, d) of every row of moments, shape (R, 4)."""
    planes = np.empty((rows.shape[0], 4))
    for r in range(rows.shape[0]):
        nx, ny, nz = normal_of(rows[r], eigenvalues(rows[r])[0])
        planes[r, 0], planes[r, 1], planes[r, 2] = nx, ny, nz
        planes[r, 3] = nx * rows[r, 2] + ny * rows[r, 3] + nz * rows[r, 4]
    return planes


def fit_regions(points, covariance, labels, rows, prior, floor_variance):
    """Moments of the labelled points, added to `prior` (R, 11), weighted along the normal of `rows` (R, 11): sums about
    the centres of these, near enough to the points to lose nothing."""
    fresh, n_shares = prior.copy(), min(threads_for(labels.size), 4)  # each thread walks over all labels
    shares, load = np.zeros(len(rows), dtype=np.int64), [0.0] * n_shares
    for r in np.argsort(-rows[:, 0], kind="stable").tolist() if n_shares > 1 else ():
        shares[r] = load.index(min(load))  # largest regions first, each to the share with the fewest points so far
        load[shares[r]] += rows[r, 0]
    grid, regions = (points, covariance, labels), (rows, hesse(rows), prior)
    in_parts(partial(_fit_shares, grid, regions, floor_variance, shares, fresh), n_shares, labels.size, singly=True)
    return fresh


@njit(cache=True)
def _fit_shares(grid, regions, floor_variance, shares, fresh, first, last):
    """The moments of the regions of some shares, in place of those of `fresh`; each region's points in grid order."""
    (points, covariance, labels), (rows, planes, prior) = grid, regions
    sums, n_cols = np.zeros(rows.shape), labels.shape[1]
    for i in range(labels.shape[0]):
        j = 0
        while j < n_cols:
            r, begin = labels[i, j], j
            while j < n_cols and labels[i, j] == r:
                j += 1
            if r >= 0 and first <= shares[r] < last:
                add_run(sums[r], points, covariance, i, begin, j, rows[r, 2:5], planes[r], floor_variance, True)
    for r in range(rows.shape[0]):
        if sums[r, 1] > 0.0:
            centre_sums(sums[r], rows[r, 2:5])
            merge_rows(prior[r], sums[r], fresh[r])


@njit(cache=True)
def shared_of_regions(shared, labels, planes):
    """Of every region: mean variance along the normal that points share with their scans, and mean scan, (R, 2)."""
    total, count = np.zeros((planes.shape[0], 2)), np.zeros(planes.shape[0])
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r >= 0:
                count[r] += 1.0
                total[r, 1] += i
                if shared.shape[0] > 1:
                    total[r, 0] += variance_from(shared, i, j, planes, r)
    return total / np.maximum(count, 1.0).reshape(-1, 1)


def grow(grid, planes, gate, floor_variance):
    """Spread regions over unlabelled points beside them that lie within the gate (chi2), ring by ring, in place. Of the
    grid (see `Sheet.grid`), rows before the start stay as they are; regions grow out of the last of them."""
    _, _, valid, labels, start = grid
    free = valid & (labels < 0)
    free[:start] = False
    beside = np.zeros_like(free)
    beside[1:] |= free[:-1]
    beside[:-1] |= free[1:]
    beside[:, 1:] |= free[:, :-1]
    beside[:, :-1] |= free[:, 1:]
    sources = np.flatnonzero(beside & (labels >= 0))
    queue = np.empty(labels.size, dtype=np.int64)
    queue[: sources.size] = sources
    _grow_from(queue, sources.size, grid, planes, gate, floor_variance)


@njit(cache=True)
def _grow_from(queue, tail, grid, planes, gate, floor_variance):
    """The same, from the places of the points that have a free one beside them: as many as `tail`, in a queue."""
    points, covariance, valid, labels, start = grid
    n_rows, n_cols = labels.shape
    head = 0
    while head < tail:
        i, j = queue[head] // n_cols, queue[head] % n_cols
        head += 1
        r = labels[i, j]
        for step in range(4):
            a = i + (step == 1) - (step == 0)
            b = j + (step == 3) - (step == 2)
            if a < start or b < 0 or a >= n_rows or b >= n_cols or not valid[a, b] or labels[a, b] >= 0:
                continue
            if residual_chi2(points, covariance, a, b, planes, r, floor_variance) <= gate:
                labels[a, b] = r
                queue[tail] = a * n_cols + b
                tail += 1


def release(grid, planes, bias, size, limit):
    """Unlabel, in place, the points that one region has in one cell where their mean distance is no chance (chi2)."""
    some_rows = partial(_release_in, grid, planes, bias, size, limit)
    in_parts(some_rows, (len(grid[2]) + size - 1) // size, grid[2].size)


@njit(cache=True)
def _release_in(grid, planes, bias, size, limit, first, last):
    """The same in the rows of cells from first to last."""
    points, covariance, labels = grid
    sums, block = np.zeros((planes.shape[0], 2)), np.full(planes.shape[0], -1)  # sums are of the block told beside them
    for i0 in range(first * size, min(last * size, labels.shape[0]), size):
        for j0 in range(0, labels.shape[1], size):
            here, i1, j1 = i0 * labels.shape[1] + j0, min(i0 + size, labels.shape[0]), min(j0 + size, labels.shape[1])
            for i in range(i0, i1):
                for j in range(j0, j1):
                    r = labels[i, j]
                    if r < 0:
                        continue
                    if block[r] != here:
                        sums[r], block[r] = 0.0, here
                    w = 1.0 / (variance_from(covariance, i, j, planes, r) + bias[r])
                    sums[r, 0] += w
                    sums[r, 1] += w * distance_of(points, i, j, planes, r)
            for i in range(i0, i1):
                for j in range(j0, j1):
                    r = labels[i, j]
                    if r >= 0 and sums[r, 0] > 0.0:
                        mean = sums[r, 1] / sums[r, 0]
                        if mean * mean > limit * (1.0 / sums[r, 0] + bias[r]):
                            labels[i, j] = -1
