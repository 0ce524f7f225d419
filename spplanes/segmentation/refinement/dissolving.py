"""Small regions that their larger neighbours explain as well are no planes: strips along a noisy corner, fringes."""

from __future__ import annotations

import numpy as np

from spplanes._jit import njit
from spplanes.fitting._moment_patches import residual_chi2

#: Points are explained block by block, this many on a side: a point alone always finds some plane that suits it.
BLOCK = 4


def dissolve(grid, sizes, order, pairs, planes, floor_variance):
    """Give the points of superfluous regions to their neighbours, in place; how many regions are dissolved. `sizes`
    (R,) become 0 for those, `order` (R,) has the smallest first, `pairs` (E, 2) are near each other, each once. Regions
    with points before the first row to work on stay; `floor_variance`, m^2, is added to that of every point."""
    labels, start = grid[3:]
    members, first = _members(labels, start, len(sizes))
    both = pairs[:, [0, 1, 1, 0]].reshape(-1, 2)  # one way and the other
    both = both[np.argsort(both[:, 0], kind="stable")]
    beside, count = np.searchsorted(both[:, 0], np.arange(len(sizes) + 1)), 0
    hosts = np.empty(len(members), dtype=np.int64)  # of every block
    for r in order[~np.isin(order, labels[:start])].tolist():
        mine, others = members[first[r] : first[r + 1]], both[beside[r] : beside[r + 1], 1]
        larger = others[sizes[others] > sizes[r]]
        if len(mine) and len(larger) and _is_superfluous(grid, mine, r, larger, planes, floor_variance, hosts):
            labels.flat[mine] = hosts[np.arange(len(mine)) // BLOCK**2]
            sizes[r] = 0
            count += 1
    return count


def near_pairs(labels: np.ndarray, gap: int) -> np.ndarray:
    """Pairs of unlike regions at most `gap` points apart along every fourth row and column: (E, 2), many times each."""
    found = [np.empty((0, 2), dtype=np.int64)]
    for lines in (labels[::BLOCK], labels[:, ::BLOCK].T):
        regions = np.pad(lines, ((0, 0), (0, gap)), constant_values=-1).ravel()
        first = np.flatnonzero(np.diff(regions, prepend=-2))
        last = np.append(first[1:], regions.size) - 1
        first, last, regions = (one[regions[first] >= 0] for one in (first, last, regions[first]))
        runs, ahead = np.arange(len(first)), 0
        while len(runs):  # of equal labels, each with those that follow it, until none is near enough
            ahead += 1
            runs = runs[: np.searchsorted(runs, len(first) - ahead)]
            runs = runs[first[runs + ahead] - last[runs] <= gap]
            found.append(np.stack((regions[runs], regions[runs + ahead]), axis=1))
    one, other = np.concatenate(found).T
    return np.stack((np.minimum(one, other), np.maximum(one, other)), axis=1)[one != other]


@njit(cache=True)
def _members(labels, start, n_regions):
    """Points of every region in the order of their blocks, as flat indices, and where each region begins."""
    first = np.zeros(n_regions + 1, dtype=np.int64)
    for i in range(start, labels.shape[0]):
        for j in range(labels.shape[1]):
            if labels[i, j] >= 0:
                first[labels[i, j] + 1] += 1
    for r in range(n_regions):
        first[r + 1] += first[r]
    place, members = first.copy(), np.empty(first[-1], dtype=np.int64)
    for i0 in range(start, labels.shape[0], BLOCK):
        for j0 in range(0, labels.shape[1], BLOCK):
            for i in range(i0, min(i0 + BLOCK, labels.shape[0])):
                for j in range(j0, min(j0 + BLOCK, labels.shape[1])):
                    r = labels[i, j]
                    if r >= 0:
                        members[place[r]] = i * labels.shape[1] + j
                        place[r] += 1
    return members, first


@njit(cache=True)
def _is_superfluous(grid, mine, region, candidates, planes, floor_variance, hosts):
    """Whether the best candidate for every block, written to `hosts`, explains the points nearly as well as the region.
    A plane of its own must lower the mean chi2 of its points by 0.15, and the sum by what three parameters gain by
    chance at 0.001. Points are explained in blocks of `BLOCK` * `BLOCK` members, one after another."""
    points, covariance, n_cols = grid[0], grid[1], grid[3].shape[1]
    limit = 0.15 * mine.shape[0] + 16.3
    for k in range(mine.shape[0]):
        i, j = mine[k] // n_cols, mine[k] % n_cols
        limit += residual_chi2(points, covariance, i, j, planes, region, floor_variance)
    other, sums = 0.0, np.zeros(candidates.shape[0])
    for k in range(mine.shape[0]):
        i, j = mine[k] // n_cols, mine[k] % n_cols
        for m in range(candidates.shape[0]):
            sums[m] += residual_chi2(points, covariance, i, j, planes, candidates[m], floor_variance)
        if (k + 1) % (BLOCK * BLOCK) == 0 or k == mine.shape[0] - 1:
            best = np.argmin(sums)
            hosts[k // (BLOCK * BLOCK)] = candidates[best]
            other += sums[best]
            if other > limit:
                return False
            sums[:] = 0.0
    return True
