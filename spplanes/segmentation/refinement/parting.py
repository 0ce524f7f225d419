"""Splitting of regions whose points lie on two parallel planes: a board that the wall around it swallowed.

A cell across the edge of a board lies half way between both planes, tilts to meet them, and joins one to the other. The
offsets of small cells from the region's plane know no tilt: fused in the order of their likeness, those of the board
become one value and those of the wall another, and the cells across the edge go with either. The region's plane is
tilted to meet both; that of its parts, with a normal in common, is not, and offsets from that show the step as it is.
"""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, njit
from spplanes.segmentation.clustering._nodes import (
    OFFSET,
    ROW,
    WEIGHT,
    N,
    common_normals,
    edges_of,
    hides_steps,
    measure,
    node_of,
    nodes_of,
    regions_of,
)
from spplanes.segmentation.clustering.ahc import find, pop, push

#: Times the offsets are measured, from the region's plane first, from that of its parts then.
ROUNDS = 3
#: Largest step inside a plane, in times the flatness.
TOLERATED = 3.0
#: Share of the variance of the tolerated step that is granted while likeness alone decides.
SHARE = 0.05


def part(points, covariance, labels, start, planes, bias, size, limit, flatness, correlation, min_points):
    """Give every part of a region that lies on a parallel plane of its own a new label, in place.

    Args:
        points, covariance, labels: the grid; see `Sheet`.
        start: first row to work on; a part with points in the rows before keeps the region's label.
        planes: (normal, d) of the regions, shape (R, 4).
        bias: variance that regions share with their scans, m^2, shape (R,).
        size: side of the cells.
        limit: largest chi2 (1 dof) of the step between parts of one plane.
        flatness: deviation from a plane that every part is granted, m; regions with less noise are not looked at: in
            them nothing hides, and what shows are the surface's own waves.
        correlation: scans over which errors shared with scans change.
        min_points: fewest points of a part.

    Returns:
        The region every new label was part of, shape (K,); new labels begin at R.
    """
    first, nodes, rows = nodes_of(points, covariance, labels, planes, size)
    hides = hides_steps(nodes, len(planes), flatness)
    pairs, edges = edges_of(first, nodes, hides)
    normals, tolerated = planes[:, :3].copy(), TOLERATED * flatness
    measure(nodes, rows, normals)
    trees = nodes.copy()
    parent = _fuse(trees, edges, limit, tolerated)
    for _ in range(ROUNDS - 1):
        common_normals(nodes, rows, parent, normals)
        measure(nodes, rows, normals)
        trees = nodes.copy()
        parent = _fuse(trees, edges, limit, tolerated)
    while _rejoin(nodes, trees, parent, pairs, edges, bias, limit, tolerated, correlation):
        pass
    label_of, origin = _number(trees, parent, hides, start // size, first, min_points)
    if len(origin):
        _relabel(labels, start, first, nodes, label_of, size)
    return origin


@njit(cache=True)
def _relabel(labels, start, first, nodes, label_of, size):
    """Give the points in the rows from `start` on the labels of their nodes, in place."""
    for i in range(start, labels.shape[0]):
        for j in range(labels.shape[1]):
            if labels[i, j] >= 0:
                labels[i, j] = label_of[node_of(first, nodes, i // size, j // size, labels[i, j])]


@inlined
def _step(a, b, tolerance):
    """Chi2 (1 dof) of the step between two nodes."""
    step = a[OFFSET] - b[OFFSET]
    return step * step / (1.0 / a[WEIGHT] + 1.0 / b[WEIGHT] + tolerance)


@njit(cache=True)
def _fuse(nodes, edges, limit, tolerated):
    """Root of every node after fusing along edges, the pair first whose step is least; nodes become those of trees."""
    parent = np.empty(nodes.shape[0], dtype=np.int64)
    for k in range(nodes.shape[0]):
        parent[k] = k
    version, stamp = np.zeros(nodes.shape[0], dtype=np.int64), np.zeros(edges.shape[0], dtype=np.int64)
    keys, items = np.empty(edges.shape[0]), np.empty(edges.shape[0], dtype=np.int64)
    size = 0
    for e in range(edges.shape[0]):
        size = push(keys, items, size, _step(nodes[edges[e, 0]], nodes[edges[e, 1]], 0.0), e)
    while size > 0:
        key, e = keys[0], items[0]
        size = pop(keys, items, size)
        a, b = find(parent, edges[e, 0]), find(parent, edges[e, 1])
        if a == b:
            continue
        if stamp[e] != version[a] + version[b]:
            stamp[e] = version[a] + version[b]
            fresh = _step(nodes[a], nodes[b], 0.0)
            if fresh > key:
                size = push(keys, items, size, fresh, e)
                continue
        if _step(nodes[a], nodes[b], SHARE * tolerated * tolerated) > limit:
            continue
        version[min(a, b)] = version[a] + version[b] + 1
        _unite(nodes, parent, a, b)
    for k in range(parent.shape[0]):
        parent[k] = find(parent, k)
    return parent


@njit(cache=True)
def _unite(nodes, parent, a, b):
    """Let two trees be one, under the earlier root."""
    if b < a:
        a, b = b, a
    both, share = nodes[a, N] + nodes[b, N], nodes[b, WEIGHT] / (nodes[a, WEIGHT] + nodes[b, WEIGHT])
    nodes[a, ROW] += nodes[b, N] / both * (nodes[b, ROW] - nodes[a, ROW])
    nodes[a, OFFSET] += share * (nodes[b, OFFSET] - nodes[a, OFFSET])
    nodes[a, WEIGHT] += nodes[b, WEIGHT]
    nodes[a, N] = both
    parent[b] = a


def _rejoin(nodes, trees, parent, pairs, edges, bias, limit, tolerated, correlation) -> bool:
    """Unite trees between which the surface has no step where they meet, each with the likest; whether there were any.

    The surface may wander over metres, but not at once: cells are compared across the border, a cell aside on either
    side where there is one, because that at the border itself may lie across the step.
    """
    border = np.flatnonzero(parent[edges[:, 0]] != parent[edges[:, 1]])
    if not len(border):
        return False
    roots = parent[edges[border]]
    aside = pairs[border]
    a, b = np.where((aside >= 0) & (parent[aside] == roots), aside, edges[border]).T
    weight = 1.0 / (1.0 / nodes[a, WEIGHT] + 1.0 / nodes[b, WEIGHT])
    step, scans = nodes[a, OFFSET] - nodes[b, OFFSET], np.abs(nodes[a, ROW] - nodes[b, ROW])
    step = np.where(roots[:, 0] < roots[:, 1], step, -step)
    drift = 2.0 * bias[regions_of(nodes[a])] * (1.0 - np.exp(-scans / correlation))
    codes, meeting = np.unique(roots.min(axis=1) * len(parent) + roots.max(axis=1), return_inverse=True)
    place, size = 2 * meeting + (scans > 2.0), 2 * len(codes)
    sums = [np.bincount(place, of, size).reshape(-1, 2) for of in (weight, weight * step, weight * drift)]
    return _unite_likest(trees, parent, codes, *_combined(*sums), limit, tolerated)


def _combined(weight: np.ndarray, moment: np.ndarray, drift: np.ndarray) -> tuple[FloatArray, FloatArray]:
    """Mean step and its variance from those inside scans, where shared errors cancel, and from scan to scan.

    Args:
        weight, moment, drift: sums of w, w step and w drift of both, shape (P, 2).
    """
    both, moments = np.zeros(len(weight)), np.zeros(len(weight))
    for way in range(2):
        w = weight[:, way] / (1.0 + drift[:, way])
        both += w
        moments += w * moment[:, way] / np.where(w > 0.0, weight[:, way], 1.0)
    return moments / both, 1.0 / both


@njit(cache=True)
def _unite_likest(trees, parent, codes, steps, variances, limit, tolerated):
    """Unite those of the pairs of trees, ascending codes (P,), that are each other's likest; whether there were any."""
    n = parent.shape[0]
    least, likest = np.empty(n), np.empty(n, dtype=np.int64)
    for k in range(n):
        least[k], likest[k] = np.inf, -1
    for p in range(codes.shape[0]):
        beyond = max(abs(steps[p]) - tolerated, 0.0)
        if beyond * beyond <= limit * variances[p]:
            chi2 = steps[p] * steps[p] / variances[p]
            for k in (codes[p] // n, codes[p] % n):
                if chi2 < least[k]:
                    least[k], likest[k] = chi2, codes[p]
    united = False
    for k in range(n):
        other = likest[k] % n
        if likest[k] >= 0 and k < other and likest[other] == likest[k]:
            _unite(trees, parent, k, other)
            united = True
    for k in range(n):
        parent[k] = find(parent, k)
    return united


def _number(nodes, parent, hides, settled_rows, first, min_points) -> tuple[np.ndarray, np.ndarray]:
    """Label of every node and the region every new label was part of: largest parts and those in settled rows stay."""
    n_settled = first[settled_rows, 0] if settled_rows < len(first) else len(nodes)
    region, roots = regions_of(nodes), np.flatnonzero(parent == np.arange(len(parent)))
    stays = np.zeros(len(nodes), dtype=bool)
    stays[parent[:n_settled]] = True
    by_size = roots[np.lexsort((-nodes[roots, N], region[roots]))]  # of equal ones the first
    stays[by_size[np.flatnonzero(np.diff(region[by_size], prepend=-1))]] = True
    new = roots[~stays[roots] & hides[region[roots]] & (nodes[roots, N] >= min_points)]
    label = region.copy()
    label[new] = len(hides) + np.arange(len(new))
    return label[parent], region[new]
