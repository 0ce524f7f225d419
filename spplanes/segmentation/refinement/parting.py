"""Splitting of regions whose points lie on two parallel planes: a board that the wall around it swallowed.

A cell across the edge of a board lies half way between both planes, tilts to meet them, and joins one to the other. The
offsets of small cells from the region's plane know no tilt: fused in the order of their likeness, those of the board
become one value and those of the wall another, and the cells across the edge go with either. The region's plane is
tilted to meet both; that of its parts, with a normal in common, is not, and offsets from that show the step as it is.
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner, njit
from spplanes.segmentation.clustering._nodes import (
    OFFSET,
    REGION,
    ROW,
    WEIGHT,
    N,
    common_normals,
    edges_of,
    hides_steps,
    measure,
    node_of,
    nodes_of,
)
from spplanes.segmentation.clustering.ahc import find, pop, push

#: Times the offsets are measured, from the region's plane first, from that of its parts then.
ROUNDS = 3
#: Largest step inside a plane, in times the flatness.
TOLERATED = 3.0
#: Share of the variance of the tolerated step that is granted while likeness alone decides.
SHARE = 0.05


@njit(cache=True)
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
    hides = hides_steps(nodes, planes.shape[0], flatness)
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
    if origin.shape[0]:
        for i in range(start, labels.shape[0]):
            for j in range(labels.shape[1]):
                if labels[i, j] >= 0:
                    labels[i, j] = label_of[node_of(first, nodes, i // size, j // size, labels[i, j])]
    return origin


@inner(cache=True)
def _step(a, b, tolerance):
    """Chi2 (1 dof) of the step between two nodes."""
    step = a[OFFSET] - b[OFFSET]
    return step * step / (1.0 / a[WEIGHT] + 1.0 / b[WEIGHT] + tolerance)


@inlined
def _drift(a, b, bias, correlation):
    """Variance that errors shared with scans add to the step between two nodes, m^2."""
    return 2.0 * bias[int(a[REGION])] * (1.0 - np.exp(-abs(a[ROW] - b[ROW]) / correlation))


@inner(cache=True)
def _fuse(nodes, edges, limit, tolerated):
    """Root of every node after fusing along edges, the pair first whose step is least; nodes become those of trees."""
    parent = np.arange(nodes.shape[0])
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


@inner(cache=True)
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


@inlined
def _rejoin(nodes, trees, parent, pairs, edges, bias, limit, tolerated, correlation):
    """Unite trees between which the surface has no step where they meet, each with the likest; whether there were any.

    The surface may wander over metres, but not at once: cells are compared across the border, a cell aside on either
    side where there is one, because that at the border itself may lie across the step.
    """
    codes, across = np.empty(edges.shape[0], dtype=np.int64), np.zeros((edges.shape[0], 2, 3))
    count = 0
    for e in range(edges.shape[0]):
        a, b = edges[e, 0], edges[e, 1]
        ra, rb = parent[a], parent[b]
        if ra == rb:
            continue
        a = pairs[e, 0] if pairs[e, 0] >= 0 and parent[pairs[e, 0]] == ra else a
        b = pairs[e, 1] if pairs[e, 1] >= 0 and parent[pairs[e, 1]] == rb else b
        w = 1.0 / (1.0 / nodes[a, WEIGHT] + 1.0 / nodes[b, WEIGHT])
        step = nodes[a, OFFSET] - nodes[b, OFFSET]
        codes[count] = min(ra, rb) * parent.shape[0] + max(ra, rb)
        drift = w * _drift(nodes[a], nodes[b], bias, correlation)
        across[count, int(abs(nodes[a, ROW] - nodes[b, ROW]) > 2.0)] = w, w * (step if ra < rb else -step), drift
        count += 1
    order = np.argsort(codes[:count], kind="mergesort")
    least, likest = np.full(parent.shape[0], np.inf), np.full(parent.shape[0], -1)
    begin = 0
    while begin < count:
        end, total = begin, np.zeros((2, 3))
        while end < count and codes[order[end]] == codes[order[begin]]:
            total += across[order[end]]
            end += 1
        code = codes[order[begin]]
        step, variance = _combined(total)
        beyond = max(abs(step) - tolerated, 0.0)
        if beyond * beyond <= limit * variance:
            chi2 = step * step / variance
            for k in (code // parent.shape[0], code % parent.shape[0]):
                if chi2 < least[k]:
                    least[k], likest[k] = chi2, code
        begin = end
    united = False
    for k in range(parent.shape[0]):
        other = likest[k] % parent.shape[0]
        if likest[k] >= 0 and k < other and likest[other] == likest[k]:
            _unite(trees, parent, k, other)
            united = True
    for k in range(parent.shape[0]):
        parent[k] = find(parent, k)
    return united


@inlined
def _combined(total):
    """Mean step and its variance from those inside scans, where shared errors cancel, and from scan to scan.

    Args:
        total: sums of w, w step and w drift of both, shape (2, 3).
    """
    weight, moment = 0.0, 0.0
    for way in range(2):
        if total[way, 0] > 0.0:
            w = total[way, 0] / (1.0 + total[way, 2])
            weight += w
            moment += w * total[way, 1] / total[way, 0]
    return moment / weight, 1.0 / weight


@inlined
def _number(nodes, parent, hides, settled_rows, first, min_points):
    """Label of every node and the region every new label was part of: largest parts and those in settled rows stay."""
    n_settled = first[settled_rows, 0] if settled_rows < first.shape[0] else nodes.shape[0]
    n_regions = hides.shape[0]
    stays, largest = np.zeros(nodes.shape[0], dtype=np.bool_), np.full(n_regions, -1)
    for k in range(n_settled):
        stays[parent[k]] = True
    for k in range(nodes.shape[0]):
        r = int(nodes[k, REGION])
        if parent[k] == k and (largest[r] < 0 or nodes[k, N] > nodes[largest[r], N]):
            largest[r] = k
    label, origin, count = np.empty(nodes.shape[0], dtype=np.int64), np.empty(nodes.shape[0], dtype=np.int64), 0
    for k in range(nodes.shape[0]):
        r = int(nodes[k, REGION])
        if parent[k] != k:
            label[k] = label[parent[k]]  # roots come first
        elif stays[k] or k == largest[r] or not hides[r] or nodes[k, N] < min_points:
            label[k] = r
        else:
            label[k] = n_regions + count
            origin[count] = r
            count += 1
    return label, origin[:count].copy()
