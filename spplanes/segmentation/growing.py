"""Regions grow over the points around them, are fitted again, and fuse where a chi2 test says they are one plane."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes.moments import ROW_SIZE, add_point
from spplanes.segmentation._patches import eigenvalues, normal_of, variance_along


@njit(cache=True)
def fit_regions(points, covariance, labels, rows, floor_variance):
    """Moments of the labelled points, weighted along the normal of the region's previous moments `rows` (R, 11)."""
    normals = np.empty((rows.shape[0], 3))
    for r in range(rows.shape[0]):
        normals[r] = normal_of(rows[r], eigenvalues(rows[r])[0])
    fresh = np.zeros((rows.shape[0], ROW_SIZE))
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r >= 0:
                n = normals[r]
                variance = variance_along(covariance[i, j], n[0], n[1], n[2]) + floor_variance
                add_point(fresh[r], points[i, j], 1.0 / variance)
    return fresh


@njit(cache=True)
def shared_of_regions(shared, labels, planes):
    """Mean variance along the normal that the points of a region share with their scans, shape (R,)."""
    total, count = np.zeros(planes.shape[0]), np.zeros(planes.shape[0])
    if shared.shape[0] > 1:
        for i in range(labels.shape[0]):
            for j in range(labels.shape[1]):
                r = labels[i, j]
                if r >= 0:
                    total[r] += variance_along(shared[i, j], planes[r, 0], planes[r, 1], planes[r, 2])
                    count[r] += 1.0
    return total / np.maximum(count, 1.0)


@njit(cache=True)
def hesse(rows):
    """(normal, d) of every row of moments, shape (R, 4)."""
    planes = np.empty((rows.shape[0], 4))
    for r in range(rows.shape[0]):
        nx, ny, nz = normal_of(rows[r], eigenvalues(rows[r])[0])
        planes[r] = nx, ny, nz, nx * rows[r, 2] + ny * rows[r, 3] + nz * rows[r, 4]
    return planes


@njit(cache=True)
def residual_chi2(point, covariance, plane, floor_variance):
    """Squared distance of a point to (normal, d) by its variance along the normal (1 dof)."""
    distance = point[0] * plane[0] + point[1] * plane[1] + point[2] * plane[2] - plane[3]
    return distance * distance / (variance_along(covariance, plane[0], plane[1], plane[2]) + floor_variance)


@njit(cache=True)
def grow(points, covariance, labels, free, planes, gate, floor_variance):
    """Spread regions over free points beside them that lie within the gate (chi2), ring by ring, in place."""
    n_rows, n_cols = labels.shape
    queue = np.empty(labels.size, dtype=np.int64)
    head, tail = 0, 0
    for i in range(n_rows):
        for j in range(n_cols):
            if labels[i, j] >= 0 and _touches_free(free, i, j):
                queue[tail] = i * n_cols + j
                tail += 1
    while head < tail:
        i, j = queue[head] // n_cols, queue[head] % n_cols
        head += 1
        r = labels[i, j]
        for step in range(4):
            a = i + (step == 1) - (step == 0)
            b = j + (step == 3) - (step == 2)
            if a < 0 or b < 0 or a >= n_rows or b >= n_cols or not free[a, b]:
                continue
            if residual_chi2(points[a, b], covariance[a, b], planes[r], floor_variance) <= gate:
                labels[a, b] = r
                free[a, b] = False
                queue[tail] = a * n_cols + b
                tail += 1


@njit(cache=True)
def _touches_free(free, i, j):
    return (
        (i > 0 and free[i - 1, j])
        or (j > 0 and free[i, j - 1])
        or (i + 1 < free.shape[0] and free[i + 1, j])
        or (j + 1 < free.shape[1] and free[i, j + 1])
    )


@njit(cache=True)
def border_pairs(labels, gap):
    """Pairs of unlike regions that meet along a row or column with at most `gap` unlabelled points between: (E, 2)."""
    n_rows, n_cols = labels.shape
    pairs = np.empty((2 * labels.size, 2), dtype=np.int64)
    count = 0
    for along in range(2):
        outer, inner = (n_rows, n_cols) if along == 0 else (n_cols, n_rows)
        for u in range(outer):
            last, since = -1, 0
            for v in range(inner):
                r = labels[u, v] if along == 0 else labels[v, u]
                if r < 0:
                    since += 1
                    continue
                if last >= 0 and r != last and since <= gap:
                    pairs[count, 0], pairs[count, 1] = min(r, last), max(r, last)
                    count += 1
                last, since = r, 0
    return pairs[:count]


@njit(cache=True)
def choose_at_borders(points, covariance, labels, planes, gate, floor_variance, smoothness):
    """Let points at borders choose: smallest chi2 plus a price per unlike neighbour (one sweep of ICM, in place)."""
    n_rows, n_cols = labels.shape
    changed = 0
    around = np.empty(8, dtype=np.int64)
    for i in range(n_rows):
        for j in range(n_cols):
            mine = labels[i, j]
            if mine == -2 or not _at_border(labels, i, j, mine):
                continue
            n_around = 0
            for a in range(max(i - 1, 0), min(i + 2, n_rows)):
                for b in range(max(j - 1, 0), min(j + 2, n_cols)):
                    if (a != i or b != j) and labels[a, b] != -2:
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
def _at_border(labels, i, j, mine):
    n_rows, n_cols = labels.shape
    return (
        (i > 0 and labels[i - 1, j] != mine and labels[i - 1, j] != -2)
        or (j > 0 and labels[i, j - 1] != mine and labels[i, j - 1] != -2)
        or (i + 1 < n_rows and labels[i + 1, j] != mine and labels[i + 1, j] != -2)
        or (j + 1 < n_cols and labels[i, j + 1] != mine and labels[i, j + 1] != -2)
    )
