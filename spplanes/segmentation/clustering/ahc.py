"""Agglomerative hierarchical clustering (AHC) of patches into planes, with a heap and a chi2 test."""

from __future__ import annotations

from heapq import heapify, heappop, heappush

import numpy as np

from spplanes._jit import inlined, inner, njit
from spplanes._rows import merge_scaled
from spplanes.fitting._moment_patches import eigenvalues, normal_of


@inlined
def one_plane_chi2(a, b, bias, work):
    """Chi2 (3 dof) of the hypothesis that two rows of moments are one plane, up to a systematic error between them.

    It is the growth of the sum of squared normalised residuals when both are fitted by one plane, which to first order
    is (b_a - b_b)^T (C_a + C_b)^-1 (b_a - b_b); it stays defined when one patch does not determine a plane. The
    systematic error, variance `bias` along z and a tilt of as much per rms extent, is granted to the smaller patch,
    whose weights shrink by 1 + bias W: a large but narrow one would turn about its long axis by more than its points
    allow.
    """
    if a[1] < b[1]:
        a, b = b, a
    scale = 1.0 / (1.0 + bias * b[1])
    merge_scaled(work, a, 1.0, b, scale)
    return eigenvalues(work)[0] - eigenvalues(a)[0] - scale * eigenvalues(b)[0]


@inlined
def step_chi2(a, b, tolerance, work):
    """Chi2 (1 dof) of the step between two parallel planes, one through each of two rows of moments. Two planes that
    are free to tilt meet each other half way, where a large and a small one or two small ones meet; if both have the
    tilt of all points together, the step is what it is. `tolerance` is the variance it may have, m^2."""
    merge_scaled(work, a, 1.0, b, 1.0)
    one = eigenvalues(work)[0]
    for k in range(5, 11):
        work[k] = a[k] + b[k]
    two = eigenvalues(work)[0]
    if one <= two:
        return 0.0
    nx, ny, nz = normal_of(work, two)
    step = (b[2] - a[2]) * nx + (b[3] - a[3]) * ny + (b[4] - a[4]) * nz
    gain = one - two
    if step == 0.0:
        return gain
    return gain / (1.0 + gain * tolerance / (step * step))


@inner(cache=True)
def find(parent, i):
    """Root of i, with path halving."""
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@inner(cache=True)
def merged_distance(a, b, work):
    """Mean squared normalised distance of the points of both rows to their common plane."""
    merge_scaled(work, a, 1.0, b, 1.0)
    return eigenvalues(work)[0] / max(work[0] - 3.0, 1.0)


@inlined
def _are_one(rows, bias, pair, flatness, correlation, limits, work):
    """Whether two patches are one plane: what they share with scans counts as far as their scans differ."""
    a, b = pair
    apart = 1.0 - np.exp(-abs(bias[a, 1] - bias[b, 1]) / correlation)
    total = 2.0 * flatness * flatness + apart * (bias[a, 0] + bias[b, 0])
    if step_chi2(rows[a], rows[b], total, work) > limits[0]:
        return False
    return one_plane_chi2(rows[a], rows[b], total, work) <= limits[1]


@njit(cache=True)
def cluster(rows, bias, edges, limits, flatness, correlation):
    """Root (N,) of every patch: they fuse along edges (E, 2), the pair with the least mean distance to its plane first.

    On return the rows of a root, and its `bias`, the variance along the normal that it shares with its scans, m^2, and
    its mean scan, (N, 2), are those of its tree. `limits` are the largest chi2 at which two patches are one plane: of
    the step between them (1 dof), of both (3 dof); `flatness`, m, is granted to every patch, errors shared with scans
    change over `correlation` scans. The keys in the heap are brought up to date when they come to its top.
    """
    parent = np.arange(rows.shape[0])
    version, stamp = np.zeros(rows.shape[0], dtype=np.int64), np.zeros(edges.shape[0], dtype=np.int64)
    work = np.empty(rows.shape[1])
    heap = [(merged_distance(rows[edges[e, 0]], rows[edges[e, 1]], work), e) for e in range(edges.shape[0])]
    heapify(heap)
    while heap:
        key, e = heappop(heap)
        a, b = find(parent, edges[e, 0]), find(parent, edges[e, 1])
        if a == b:
            continue
        if stamp[e] != version[a] + version[b]:
            stamp[e] = version[a] + version[b]
            fresh = merged_distance(rows[a], rows[b], work)
            if fresh > key:
                heappush(heap, (fresh, e))
                continue
        if _are_one(rows, bias, (a, b), flatness, correlation, limits, work):
            a, b = min(a, b), max(a, b)
            merge_scaled(work, rows[a], 1.0, rows[b], 1.0)
            for k in range(bias.shape[1]):  # of what is shared with scans the mean by weights
                bias[a, k] = (bias[a, k] * rows[a, 1] + bias[b, k] * rows[b, 1]) / work[1]
            for k in range(work.shape[0]):
                rows[a, k] = work[k]
            parent[b] = a
            version[a] += version[b] + 1
    for i in range(parent.shape[0]):
        parent[i] = find(parent, i)
    return parent
