"""Points at the borders of regions go where they fit: block by block first, then one by one."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner, njit
from spplanes.fitting._moment_patches import distance_of, residual_chi2, variance_from


@njit(cache=True)
def choose_blocks(grid, planes, gate, floor_variance, size):
    """Move the points that a region has in a square block to the neighbour that explains them better; how many. One
    point's noise may be wider than the step between two planes; that of a block is not. One sweep, in place. They stay
    below a chi2 of 9 of their mean distance, and where no other region explains them better by a chi2 of 4."""
    _, _, _, labels, start = grid
    found, sums, moved = np.empty(8, dtype=np.int64), np.empty(8), 0  # so many regions around a block are looked at
    for i0 in range(start, labels.shape[0], size):
        for j0 in range(0, labels.shape[1], size):
            block = i0, j0, min(i0 + size, labels.shape[0]), min(j0 + size, labels.shape[1])
            n_found = _regions_around(labels, block, found)
            for k in range(n_found if n_found > 1 else 0):
                if not _misfit(grid, block, found[k], planes, floor_variance) < 9.0:
                    moved += _move_block(grid, block, found[:n_found], k, planes, gate, floor_variance, sums)
    return moved


@inner(cache=True)
def _move_block(grid, block, found, k, planes, gate, floor_variance, sums):
    """Move the points of region found[k] in a block to the best of those found, if that is far better; how many."""
    (points, covariance, _, labels, _), (i0, j0, i1, j1), inside = grid, block, 0
    for m in range(found.shape[0]):
        sums[m] = 0.0
    for i in range(i0, i1):
        for j in range(j0, j1):
            if labels[i, j] == found[k]:
                inside += 1
                for m in range(found.shape[0]):
                    cost = residual_chi2(points, covariance, i, j, planes, found[m], floor_variance)
                    sums[m] += min(cost, 2.0 * gate)
    best = np.argmin(sums[: found.shape[0]])
    if not sums[best] < sums[k] - 4.0:
        return 0
    for i in range(i0, i1):
        for j in range(j0, j1):
            if labels[i, j] == found[k]:
                labels[i, j] = found[best]
    return inside


@inner(cache=True)
def _misfit(grid, block, region, planes, floor_variance):
    """Chi2 (1 dof) of the mean distance from its plane of the points that a region has in a block."""
    (points, covariance, _, labels, _), (i0, j0, i1, j1) = grid, block
    weight, mean = 0.0, 0.0
    for i in range(i0, i1):
        for j in range(j0, j1):
            if labels[i, j] == region:
                w = 1.0 / (variance_from(covariance, i, j, planes, region) + floor_variance)
                weight += w
                mean += w * distance_of(points, i, j, planes, region)
    if weight == 0.0:
        return 0.0
    mean /= weight
    return mean * mean / (1.0 / weight + floor_variance)


@inner(cache=True)
def _regions_around(labels, block, found):
    """Different regions in a block and in a frame one point wide around it; returns their number."""
    (i0, j0, i1, j1), count = block, 0
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
def choose_points(grid, planes, gate, floor_variance, smoothness):
    """Let points at borders choose: smallest chi2 plus a price per unlike neighbour (one sweep of ICM, in place)."""
    points, covariance, valid, labels, start = grid
    n_rows, n_cols = labels.shape
    changed = 0
    found, votes = np.empty(9, dtype=np.int64), np.empty(9, dtype=np.int64)
    at_border = np.empty(n_cols, dtype=np.bool_)
    for i in range(start, n_rows):
        _mark_border(labels, valid, i, at_border)
        for j in range(n_cols):
            mine = labels[i, j]
            if not (at_border[j] or (j > 0 and valid[i, j] and valid[i, j - 1] and labels[i, j - 1] != mine)):
                continue
            n_found, n_around = _votes_around(labels, valid, i, j, found, votes)
            best, best_cost = -1, np.inf
            for k in range(n_found):
                cost = gate
                if found[k] >= 0:
                    cost = residual_chi2(points, covariance, i, j, planes, found[k], floor_variance)
                    if cost > gate:
                        continue
                cost += smoothness * (n_around - votes[k])
                if cost < best_cost:
                    best, best_cost = found[k], cost
            if best != mine:
                labels[i, j] = best
                changed += 1
    return changed


@inlined
def _votes_around(labels, valid, i, j, found, votes):
    """Labels of a point, first, and of the returns around it, and how many of those have each; how many of either."""
    found[0], votes[0] = labels[i, j], 0
    n_found, n_around = 1, 0
    for a in range(max(i - 1, 0), min(i + 2, labels.shape[0])):
        for b in range(max(j - 1, 0), min(j + 2, labels.shape[1])):
            if (a == i and b == j) or not valid[a, b]:
                continue
            n_around += 1
            k = 0
            while k < n_found and found[k] != labels[a, b]:
                k += 1
            if k == n_found:
                found[k], votes[k] = labels[a, b], 0
                n_found += 1
            votes[k] += 1
    return n_found, n_around


@inlined
def _mark_border(labels, valid, i, marked):
    """Mark the returns of row i beside a return of another label: whole rows at once, which the compiler vectorises."""
    above, below = max(i - 1, 0), min(i + 1, labels.shape[0] - 1)
    for j in range(labels.shape[1]):
        marked[j] = ((labels[i, j] != labels[above, j]) & valid[above, j]) | (
            (labels[i, j] != labels[below, j]) & valid[below, j]
        )
    for j in range(1, labels.shape[1]):
        unlike = labels[i, j] != labels[i, j - 1]
        marked[j] |= unlike & valid[i, j - 1]
        marked[j - 1] |= unlike & valid[i, j]
    for j in range(labels.shape[1]):
        marked[j] &= valid[i, j]
