"""Regions grow over the points around them, are fitted again, and fuse where a chi2 test says they are one plane."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes.moments import merge_rows
from spplanes.segmentation._patches import (
    add_run,
    centre_sums,
    distance_of,
    eigenvalues,
    normal_of,
    residual_chi2,
    variance_from,
)


@njit(cache=True)
def hesse(rows):
    """(normal, d) of every row of moments, shape (R, 4)."""
    planes = np.empty((rows.shape[0], 4))
    for r in range(rows.shape[0]):
        nx, ny, nz = normal_of(rows[r], eigenvalues(rows[r])[0])
        planes[r] = nx, ny, nz, nx * rows[r, 2] + ny * rows[r, 3] + nz * rows[r, 4]
    return planes


@njit(cache=True)
def fit_regions(points, covariance, labels, rows, prior, floor_variance):
    """Moments of the labelled points, added to `prior` (R, 11), weighted along the normal of `rows` (R, 11).

    Sums are taken about the centres of `rows`, near enough to the points to lose nothing.
    """
    planes, sums = hesse(rows), np.zeros(rows.shape)
    n_cols = labels.shape[1]
    for i in range(labels.shape[0]):
        j = 0
        while j < n_cols:
            r, begin = labels[i, j], j
            while j < n_cols and labels[i, j] == r:
                j += 1
            if r >= 0:
                add_run(sums[r], points, covariance, i, begin, j, rows[r, 2:5], planes[r], floor_variance, True)
    fresh = prior.copy()
    for r in range(rows.shape[0]):
        if sums[r, 1] > 0.0:
            centre_sums(sums[r], rows[r, 2:5])
            merge_rows(prior[r], sums[r], fresh[r])
    return fresh


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


@njit(cache=True)
def grow(points, covariance, valid, labels, start, planes, gate, floor_variance):
    """Spread regions over unlabelled points beside them that lie within the gate (chi2), ring by ring, in place.

    Rows before `start` stay as they are; regions grow out of the last of them.
    """
    n_rows, n_cols = labels.shape
    queue = np.empty(labels.size, dtype=np.int64)
    head, tail = 0, 0
    marked = np.empty(n_cols, dtype=np.bool_)
    for i in range(max(start - 1, 0), n_rows):
        _mark_sources(labels, valid, start, i, marked)
        for j in range(n_cols):
            if marked[j]:
                queue[tail] = i * n_cols + j
                tail += 1
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


@njit(cache=True)
def _mark_sources(labels, valid, start, i, marked):
    """Mark the labelled points of row i beside a free one in the rows from `start` on, whole rows at once."""
    n_rows, n_cols = labels.shape
    marked[:] = False
    for a in range(max(i - 1, start), min(i + 2, n_rows)):
        if a != i:
            for j in range(n_cols):
                marked[j] |= valid[a, j] & (labels[a, j] < 0)
    if i >= start:
        for j in range(1, n_cols):
            marked[j] |= valid[i, j - 1] & (labels[i, j - 1] < 0)
            marked[j - 1] |= valid[i, j] & (labels[i, j] < 0)
    for j in range(n_cols):
        marked[j] &= labels[i, j] >= 0


@njit(cache=True)
def release(points, covariance, labels, planes, bias, size, limit):
    """Unlabel, in place, the points that one region has in one cell where their mean distance is no chance (chi2)."""
    sums = np.zeros((planes.shape[0], 2))
    for i0 in range(0, labels.shape[0], size):
        for j0 in range(0, labels.shape[1], size):
            i1, j1 = min(i0 + size, labels.shape[0]), min(j0 + size, labels.shape[1])
            for sweep in range(3):
                for i in range(i0, i1):
                    for j in range(j0, j1):
                        r = labels[i, j]
                        if r < 0:
                            continue
                        if sweep == 0:
                            w = 1.0 / (variance_from(covariance, i, j, planes, r) + bias[r])
                            sums[r, 0] += w
                            sums[r, 1] += w * distance_of(points, i, j, planes, r)
                        elif sweep == 1 and sums[r, 0] > 0.0:
                            mean = sums[r, 1] / sums[r, 0]
                            off = mean * mean > limit * (1.0 / sums[r, 0] + bias[r])
                            sums[r, 0], sums[r, 1] = (-1.0 if off else 0.0), 0.0
                        elif sweep == 2 and sums[r, 0] < 0.0:
                            labels[i, j] = -2 - r
            for i in range(i0, i1):
                for j in range(j0, j1):
                    if labels[i, j] <= -2:
                        sums[-2 - labels[i, j], 0] = 0.0
                        labels[i, j] = -1


@njit(cache=True)
def border_pairs(points, covariance, valid, views, labels, planes, sizes, bias, gap, hidden):
    """Pairs of unlike regions, (E, 2), that touch, or that an occluder parts along a row or column.

    With an occluder, the points between lie clearly before the plane; at most `gap` of them are missing, up to four of
    its edges lie on the plane. It is at most `gap` points wide, or `hidden` times as wide as the smaller region, which
    else would not tell what is behind it. A gap of 0 asks for regions that touch. Points on the plane or behind it, a
    seam or a doorway, show that the surface ends.
    """
    n_rows, n_cols = labels.shape
    pairs = np.empty((4 * labels.size, 2), dtype=np.int64)
    count = 0
    for along in range(2):
        outer, inner = (n_rows, n_cols) if along == 0 else (n_cols, n_rows)
        for u in range(outer):
            for v in range(1, inner):
                i, j = (u, v) if along == 0 else (v, u)
                r = labels[i, j]
                if r < 0 or r == (labels[i, j - 1] if along == 0 else labels[i - 1, j]):
                    continue
                on_plane, before, missing = 0, 0, 0
                widest = max(gap, int(hidden * np.sqrt(sizes[r]))) if gap else 0
                for back in range(1, min(widest + 1, v) + 1):
                    a, b = (i, j - back) if along == 0 else (i - back, j)
                    q = labels[a, b]
                    if q == r:
                        break
                    near = back <= gap + 1 or back <= hidden * np.sqrt(sizes[max(q, 0)])
                    if q >= 0 and near and (back == 1 or before > 0) and count < pairs.shape[0]:
                        pairs[count, 0], pairs[count, 1] = min(q, r), max(q, r)
                        count += 1
                    side = 1
                    if valid[a, b]:
                        side = _side(points, covariance, a, b, views, planes, r, bias[r])
                    else:
                        missing += 1
                    if missing > gap:
                        break
                    if side > 0:
                        before += 1
                    elif side == 0 and q < 0 and on_plane < 4:
                        on_plane += 1
                    else:
                        break
    return pairs[:count]


@njit(cache=True)
def _side(points, covariance, i, j, views, planes, r, bias):
    """1: the point lies before the plane, on the viewpoint's side; -1: behind it; 0: within its noise and tolerance."""
    distance = distance_of(points, i, j, planes, r)
    eye = views[i, 0] * planes[r, 0] + views[i, 1] * planes[r, 1] + views[i, 2] * planes[r, 2] - planes[r, 3]
    if distance * distance <= 9.0 * variance_from(covariance, i, j, planes, r) + 25.0 * bias:
        return 0
    return 1 if distance * eye > 0.0 else -1
