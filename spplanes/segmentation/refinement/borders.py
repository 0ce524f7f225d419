"""Points at the borders of regions go where they fit: block by block first, then one by one."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner, njit
from spplanes._threads import in_parts
from spplanes.fitting._moment_patches import distance_of, residual_chi2, variance_from

#: Chi2 by which another region must explain the points of a block better before they change sides.
BLOCK_GAIN = 4.0
#: Chi2 (1 dof) of the mean distance of a block's points from their region's plane, below which they stay.
BLOCK_MISFIT = 9.0
#: Regions looked at around one block.
MANY = 8
#: Blocks that have one label, frame included; whose regions all fit; one of whose regions does not.
UNIFORM, FITTING, MISFIT = 0, 1, 2


def choose_blocks(grid, planes, gate, floor_variance, size):
    """Move the points that a region has in a square block to the neighbouring region that explains them better.

    One point's noise may be wider than the step between two planes; that of a block is not. One sweep, in place.
    Which points may move at all is found first, block by block: it does not depend on what others do.
    For the grid see `Sheet.grid`.

    Returns:
        Number of points moved.
    """
    _, _, _, labels, start = grid
    state = np.zeros(((len(labels) - start + size - 1) // size, (labels.shape[1] + size - 1) // size), dtype=np.uint8)

    def some(first: int, last: int) -> None:
        _find_misfits(grid, planes, floor_variance, size, first, last, state)

    in_parts(some, len(state), labels.size)
    return _move_blocks(grid, planes, gate, floor_variance, size, state)


@njit(cache=True)
def _find_misfits(grid, planes, floor_variance, size, first, last, state):
    """Write to `state`, shape (blocks, blocks), what the blocks in the rows of blocks from first to last are."""
    _, _, _, labels, start = grid
    found = np.empty(MANY, dtype=np.int64)
    for u in range(first, last):
        i0 = start + u * size
        i1 = min(i0 + size, labels.shape[0])
        for v in range(state.shape[1]):
            j0, j1 = v * size, min((v + 1) * size, labels.shape[1])
            if _is_uniform(labels, i0, j0, i1, j1):
                state[u, v] = UNIFORM
                continue
            n_found = _regions_around(labels, i0, j0, i1, j1, found)
            state[u, v] = MISFIT if n_found == MANY else FITTING  # of so many, others may be looked at later
            for k in range(n_found):
                chi2 = _misfit(grid, (i0, j0, i1, j1), found[k], planes, floor_variance)
                if not chi2 < BLOCK_MISFIT:
                    state[u, v] = MISFIT
                    break


@njit(cache=True)
def _move_blocks(grid, planes, gate, floor_variance, size, state):
    """The moves, block after block; see `choose_blocks`."""
    points, covariance, _, labels, start = grid
    found, sums, moved = np.empty(MANY, dtype=np.int64), np.empty(MANY), 0
    for u in range(state.shape[0]):
        for v in range(state.shape[1]):
            if state[u, v] != MISFIT:
                continue
            i0, j0 = start + u * size, v * size
            i1, j1 = min(i0 + size, labels.shape[0]), min(j0 + size, labels.shape[1])
            n_found, before = _regions_around(labels, i0, j0, i1, j1, found), moved
            for k in range(n_found if n_found > 1 else 0):
                mine, inside = found[k], 0
                if _misfit(grid, (i0, j0, i1, j1), mine, planes, floor_variance) < BLOCK_MISFIT:
                    continue
                for m in range(n_found):
                    sums[m] = 0.0
                for i in range(i0, i1):
                    for j in range(j0, j1):
                        if labels[i, j] == mine:
                            inside += 1
                            for m in range(n_found):
                                cost = residual_chi2(points, covariance, i, j, planes, found[m], floor_variance)
                                sums[m] += min(cost, 2.0 * gate)
                if inside == 0:
                    continue
                best = 0
                for m in range(1, n_found):
                    best = m if sums[m] < sums[best] else best
                if sums[best] < sums[k] - BLOCK_GAIN:
                    moved += inside
                    for i in range(i0, i1):
                        for j in range(j0, j1):
                            if labels[i, j] == mine:
                                labels[i, j] = found[best]
            if moved > before:
                _wake_neighbours(state, u, v)
    return moved


@inlined
def _wake_neighbours(state, u, v):
    """Look at the blocks beside and below a changed one that were alike all round: their frames may no longer be."""
    for a, b in ((u, v + 1), (u + 1, v - 1), (u + 1, v), (u + 1, v + 1)):
        if a < state.shape[0] and 0 <= b < state.shape[1] and state[a, b] == UNIFORM:
            state[a, b] = MISFIT


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


@inlined
def _is_uniform(labels, i0, j0, i1, j1):
    """Whether a block and the frame one point wide around it have one label: most have, and rows compare fast."""
    j0, j1 = max(j0 - 1, 0), min(j1 + 1, labels.shape[1])
    one, unlike = labels[i0, j0], 0
    for i in range(max(i0 - 1, 0), min(i1 + 1, labels.shape[0])):
        for j in range(j0, j1):
            unlike |= labels[i, j] ^ one
        if unlike != 0:
            return False
    return True


@inner(cache=True)
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
