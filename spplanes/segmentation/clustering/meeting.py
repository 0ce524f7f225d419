"""Which regions meet: side by side, or where an occluder stands before the surface."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, njit
from spplanes._threads import in_parts
from spplanes.fitting._moment_patches import distance_of, variance_from

#: Pairs that were found last, by which most repetitions are left out; a power of two.
RECENT = 256


def border_pairs(grid, views, regions, gap, hidden):
    """Pairs of unlike regions, (E, 2), that touch, or that an occluder parts along a row or column.

    With an occluder, the points between lie clearly before the plane; at most `gap` of them are missing, up to four of
    its edges lie on the plane. It is at most `gap` points wide, or `hidden` times as wide as the smaller region, which
    else would not tell what is behind it. A gap of 0 asks for regions that touch. Points on the plane or behind it, a
    seam or a doorway, show that the surface ends. Some pairs come several times, and in no particular order.

    For the grid see `Sheet.grid`; of the regions, planes (normal, d), numbers of points and tolerances, m^2.
    """
    found: list[np.ndarray] = []
    in_parts(
        lambda first, last: found.append(_pairs_of_rows(grid, views, regions, gap, hidden, first, last)),
        len(grid[3]),
        grid[3].size,
    )
    return np.concatenate(found)


@njit(cache=True)
def _pairs_of_rows(grid, views, regions, gap, hidden, first, last):
    """The pairs with one region in the rows from first to last, beside or above the other."""
    (points, covariance, valid, labels, _), (planes, sizes, bias) = grid, regions
    pairs, count = np.empty((1024, 2), dtype=np.int64), 0
    recent = np.full((RECENT, 2), -1, dtype=np.int64)
    for i in range(first, last):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r < 0:
                continue
            for along in range(2):
                before = j if along == 0 else i
                if before == 0 or r == (labels[i, j - 1] if along == 0 else labels[i - 1, j]):
                    continue
                on_plane, in_front, missing = 0, 0, 0
                widest = max(gap, int(hidden * np.sqrt(sizes[r]))) if gap else 0
                farthest = min(widest + 1, before)
                for back in range(1, farthest + 1):
                    a, b = (i, j - back) if along == 0 else (i - back, j)
                    q = labels[a, b]
                    if q == r:
                        break
                    near = back <= gap + 1 or back <= hidden * np.sqrt(sizes[max(q, 0)])
                    if q >= 0 and near and (back == 1 or in_front > 0):
                        if count == pairs.shape[0]:
                            pairs = _with_room(pairs)
                        count += _enter(pairs, count, recent, min(q, r), max(q, r))
                    if back == farthest:
                        break
                    missing += not valid[a, b]
                    if missing > gap:
                        break
                    side = _side(points, covariance, (a, b), views, planes, r, bias[r]) if valid[a, b] else 1
                    if side > 0:
                        in_front += 1
                    elif side == 0 and q < 0 and on_plane < 4:
                        on_plane += 1
                    else:
                        break
    return pairs[:count]


@inlined
def _with_room(pairs):
    """Pairs with room for as many behind them."""
    result = np.empty((2 * pairs.shape[0], 2), dtype=np.int64)
    for k in range(pairs.shape[0]):
        result[k, 0], result[k, 1] = pairs[k, 0], pairs[k, 1]
    return result


@inlined
def _enter(pairs, count, recent, q, r):
    """Put a pair down unless it was there lately; returns whether."""
    place = (31 * q + r) & (RECENT - 1)
    if recent[place, 0] == q and recent[place, 1] == r:
        return 0
    recent[place, 0], recent[place, 1] = q, r
    pairs[count, 0], pairs[count, 1] = q, r
    return 1


@inlined
def _side(points, covariance, place, views, planes, r, bias):
    """1: the point lies before the plane, on the viewpoint's side; -1: behind it; 0: within its noise and tolerance."""
    i, j = place
    distance = distance_of(points, i, j, planes, r)
    eye = views[i, 0] * planes[r, 0] + views[i, 1] * planes[r, 1] + views[i, 2] * planes[r, 2] - planes[r, 3]
    if distance * distance <= 9.0 * variance_from(covariance, i, j, planes, r) + 25.0 * bias:
        return 0
    return 1 if distance * eye > 0.0 else -1
