"""Points at the borders of regions go where they fit: block by block first, then one by one."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes.segmentation._patches import variance_along
from spplanes.segmentation.growing import residual_chi2

#: Chi2 by which another region must explain the points of a block better before they change sides.
BLOCK_GAIN = 4.0
#: Chi2 (1 dof) of the mean distance of a block's points from their region's plane, below which they stay.
BLOCK_MISFIT = 9.0
#: Regions looked at around one block.
MANY = 8


@njit(cache=True)
def choose_blocks(points, covariance, labels, start, planes, gate, floor_variance, size):
    """Move the points that a region has in a square block to the neighbouring region that explains them better.

    One point's noise may be wider than the step between two planes; that of a block is not. One sweep, in place.

    Returns:
        Number of points moved.
    """
    n_rows, n_cols = labels.shape
    found, sums, moved = np.empty(MANY, dtype=np.int64), np.empty(MANY), 0
    for i0 in range(start, n_rows, size):
        for j0 in range(0, n_cols, size):
            i1, j1 = min(i0 + size, n_rows), min(j0 + size, n_cols)
            n_found = _regions_around(labels, i0, j0, i1, j1, found)
            if n_found < 2:
                continue
            for k in range(n_found):
                mine, inside = found[k], 0
                if (
                    _misfit(points, covariance, labels, i0, j0, i1, j1, mine, planes[mine], floor_variance)
                    < BLOCK_MISFIT
                ):
                    continue
                sums[:n_found] = 0.0
                for i in range(i0, i1):
                    for j in range(j0, j1):
                        if labels[i, j] == mine:
                            inside += 1
                            for m in range(n_found):
                                cost = residual_chi2(points[i, j], covariance[i, j], planes[found[m]], floor_variance)
                                sums[m] += min(cost, 2.0 * gate)
                if inside == 0:
                    continue
                best = sums[:n_found].argmin()
                if sums[best] < sums[k] - BLOCK_GAIN:
                    moved += inside
                    for i in range(i0, i1):
                        for j in range(j0, j1):
                            if labels[i, j] == mine:
                                labels[i, j] = found[best]
    return moved


@njit(cache=True)
def _misfit(points, covariance, labels, i0, j0, i1, j1, region, plane, floor_variance):
    """Chi2 (1 dof) of the mean distance from its plane of the points that a region has in a block."""
    weight, mean = 0.0, 0.0
    for i in range(i0, i1):
        for j in range(j0, j1):
            if labels[i, j] == region:
                p = points[i, j]
                w = 1.0 / (variance_along(covariance[i, j], plane[0], plane[1], plane[2]) + floor_variance)
                weight += w
                mean += w * (p[0] * plane[0] + p[1] * plane[1] + p[2] * plane[2] - plane[3])
    if weight == 0.0:
        return 0.0
    mean /= weight
    return mean * mean / (1.0 / weight + floor_variance)


@njit(cache=True)
def _regions_around(labels, i0, j0, i1, j1, found):
    """Different regions in a block and in a frame one point wide around it; returns their number."""
    count = 0
    for i in range(max(i0 - 1, 0), min(i1 + 1, labels.shape[0])):
        last = -1
        for j in range(max(j0 - 1, 0), min(j1 + 1, labels.shape[1])):
            r = labels[i, j]
            if r < 0 or r == last:
                continue
            last = r
            known = False
            for k in range(count):
                known = known or found[k] == r
            if not known and count < found.shape[0]:
                found[count] = r
                count += 1
    return count


@njit(cache=True)
def choose_points(points, covariance, valid, labels, start, planes, gate, floor_variance, smoothness):
    """Let points at borders choose: smallest chi2 plus a price per unlike neighbour (one sweep of ICM, in place)."""
    n_rows, n_cols = labels.shape
    changed = 0
    around = np.empty(8, dtype=np.int64)
    for i in range(start, n_rows):
        for j in range(n_cols):
            mine = labels[i, j]
            if not valid[i, j] or not _at_border(labels, valid, i, j, mine):
                continue
            n_around = 0
            for a in range(max(i - 1, 0), min(i + 2, n_rows)):
                for b in range(max(j - 1, 0), min(j + 2, n_cols)):
                    if (a != i or b != j) and valid[a, b]:
                        around[n_around] = labels[a, b]
                        n_around += 1
            best, best_cost = -1, np.inf
            for k in range(-1, n_around):
                label = mine if k < 0 else around[k]
                cost = gate
                if label >= 0:
                    cost = residual_chi2(points[i, j], covariance[i, j], planes[label], floor_variance)
                    if cost > gate:
                        continue
                for m in range(n_around):
                    cost += smoothness * (around[m] != label)
                if cost < best_cost:
                    best, best_cost = label, cost
            if best != mine:
                labels[i, j] = best
                changed += 1
    return changed


@njit(cache=True)
def _at_border(labels, valid, i, j, mine):
    n_rows, n_cols = labels.shape
    return (
        (i > 0 and labels[i - 1, j] != mine and valid[i - 1, j])
        or (j > 0 and labels[i, j - 1] != mine and valid[i, j - 1])
        or (i + 1 < n_rows and labels[i + 1, j] != mine and valid[i + 1, j])
        or (j + 1 < n_cols and labels[i, j + 1] != mine and valid[i, j + 1])
    )
