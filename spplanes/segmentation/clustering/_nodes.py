"""What small cells show of the regions that have points in them: moments, offsets from planes, neighbours."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner, njit
from spplanes._rows import merge_scaled
from spplanes.fitting._moment_patches import centre_sums, eigenvalues, normal_of, variance_from
from spplanes.moments import ROW_SIZE

#: What is known of a node, the points of one region in one cell: number, weight, mean distance from the plane, mean row
#: of the grid, region.
N, WEIGHT, OFFSET, ROW, REGION = range(5)


@njit(cache=True)
def nodes_of(points, covariance, labels, planes, size):
    """First node of every cell, shape (R, C + 1), the nodes (K, 5) in the order of their cells, and moments (K, 11)."""
    n_rows, n_cols = (labels.shape[0] + size - 1) // size, (labels.shape[1] + size - 1) // size
    first, count = np.zeros((n_rows, n_cols + 1), dtype=np.int64), 0
    nodes, rows, about = np.zeros((1024, 5)), np.zeros((1024, ROW_SIZE)), np.zeros((1024, 3))
    for ci in range(n_rows):
        for cj in range(n_cols):
            first[ci, cj] = count
            for i in range(ci * size, min((ci + 1) * size, labels.shape[0])):
                for j in range(cj * size, min((cj + 1) * size, labels.shape[1])):
                    r = labels[i, j]
                    if r < 0:
                        continue
                    k = first[ci, cj]
                    while k < count and nodes[k, REGION] != r:
                        k += 1
                    if k == count:
                        count += 1
                        if count == nodes.shape[0]:
                            nodes, rows, about = _with_room(nodes), _with_room(rows), _with_room(about)
                        nodes[k, REGION] = r
                        about[k, 0], about[k, 1], about[k, 2] = points[i, j, 0], points[i, j, 1], points[i, j, 2]
                    w = 1.0 / variance_from(covariance, i, j, planes, r)
                    _add(rows[k], w, points[i, j, 0], points[i, j, 1], points[i, j, 2], about[k])
                    nodes[k, ROW] += i
        first[ci, n_cols] = count
    for k in range(count):
        centre_sums(rows[k], about[k])
        nodes[k, N], nodes[k, WEIGHT] = rows[k, 0], rows[k, 1]
        nodes[k, ROW] /= nodes[k, N]
    return first, nodes[:count], rows[:count]


@inner(cache=True)
def _with_room(rows):
    """Rows with as many zeros behind them."""
    result = np.zeros((2 * rows.shape[0], rows.shape[1]))
    for k in range(rows.shape[0]):
        for m in range(rows.shape[1]):
            result[k, m] = rows[k, m]
    return result


@inlined
def _add(sums, w, x, y, z, about):
    """Add a point to sums about a point near it."""
    x, y, z = x - about[0], y - about[1], z - about[2]
    sums[0] += 1.0
    sums[1] += w
    sums[2] += w * x
    sums[3] += w * y
    sums[4] += w * z
    sums[5] += w * x * x
    sums[6] += w * x * y
    sums[7] += w * x * z
    sums[8] += w * y * y
    sums[9] += w * y * z
    sums[10] += w * z * z


@inner(cache=True)
def node_of(first, nodes, ci, cj, region):
    """The node of a region in a cell, or -1."""
    for k in range(first[ci, cj], first[ci, cj + 1]):
        if nodes[k, REGION] == region:
            return k
    return -1


@njit(cache=True)
def edges_of(first, nodes, hides):
    """Pairs of nodes of one region in neighbouring cells, and those one cell further on either side or -1: (E, 2)."""
    pairs, edges = np.empty((2 * nodes.shape[0], 2), dtype=np.int64), np.empty((2 * nodes.shape[0], 2), dtype=np.int64)
    n_rows, n_cols, count = first.shape[0], first.shape[1] - 1, 0
    for ci in range(n_rows):
        for cj in range(n_cols):
            for k in range(first[ci, cj], first[ci, cj + 1]):
                r = int(nodes[k, REGION])
                for step in range(2 if hides[r] else 0):
                    di, dj = step, 1 - step
                    if ci + di >= n_rows or cj + dj >= n_cols:
                        continue
                    other = node_of(first, nodes, ci + di, cj + dj, r)
                    if other < 0:
                        continue
                    inside = ci >= di and cj >= dj
                    pairs[count, 0] = node_of(first, nodes, ci - di, cj - dj, r) if inside else -1
                    inside = ci + 2 * di < n_rows and cj + 2 * dj < n_cols
                    pairs[count, 1] = node_of(first, nodes, ci + 2 * di, cj + 2 * dj, r) if inside else -1
                    edges[count, 0], edges[count, 1] = k, other
                    count += 1
    return pairs[:count], edges[:count]


def regions_of(nodes: FloatArray) -> np.ndarray:
    """Region of every node, shape (K,)."""
    return nodes[:, REGION].astype(np.int64)


def hides_steps(nodes: FloatArray, n_regions: int, flatness: float) -> np.ndarray:
    """Whether the points of a region have more noise than surfaces are granted, shape (R,) bool."""
    number, weight = (np.bincount(regions_of(nodes), nodes[:, of], n_regions) for of in (N, WEIGHT))
    return number > flatness * flatness * weight


def measure(nodes: FloatArray, rows: FloatArray, normals: FloatArray) -> None:
    """Offsets of the nodes along the normals of their regions, in place, from the region's first node."""
    region = regions_of(nodes)
    origin = np.empty(len(normals), dtype=np.int64)
    origin[region[::-1]] = np.arange(len(nodes))[::-1]  # of several the last that is written stays
    along = normals[region] * (rows[:, 2:5] - rows[origin[region], 2:5])
    nodes[:, OFFSET] = along[:, 0] + along[:, 1] + along[:, 2]


@njit(cache=True)
def common_normals(nodes, rows, parent, normals):
    """The normals of parallel planes, one through each tree of a region, in place."""
    trees, inside = rows.copy(), np.zeros((normals.shape[0], ROW_SIZE))
    work = np.empty(ROW_SIZE)
    for k in range(rows.shape[0]):
        if parent[k] != k:
            merge_scaled(work, trees[parent[k]], 1.0, rows[k], 1.0)
            for m in range(ROW_SIZE):
                trees[parent[k], m] = work[m]
    for k in range(rows.shape[0]):
        if parent[k] == k:
            for m in range(5, ROW_SIZE):
                inside[int(nodes[k, REGION]), m] += trees[k, m]
    for r in range(normals.shape[0]):
        if inside[r, 5] + inside[r, 8] + inside[r, 10] > 0.0:
            normals[r, 0], normals[r, 1], normals[r, 2] = normal_of(inside[r], eigenvalues(inside[r])[0])
