"""The quad filter: which neighbours in an organised grid lie on one surface (chi2 test on the jump in depth)."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes.segmentation._patches import variance_along


@njit(cache=True)
def _jump_chi2(a, b, cov_a, cov_b, view, tangent):
    """Chi2 (1 dof) of the step in depth that no surface seen at less than the steepest incidence explains."""
    ax, ay, az = a[0] - view[0], a[1] - view[1], a[2] - view[2]
    ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    range_sq = ax * ax + ay * ay + az * az
    if range_sq == 0.0:
        return np.inf
    along = ex * ax + ey * ay + ez * az
    along_sq = along * along / range_sq
    across_sq = max(ex * ex + ey * ey + ez * ez - along_sq, 0.0)
    if along_sq <= tangent * tangent * across_sq:
        return 0.0
    rest = np.sqrt(along_sq) - tangent * np.sqrt(across_sq)
    s = 1.0 / np.sqrt(range_sq)
    variance = variance_along(cov_a, ax * s, ay * s, az * s) + variance_along(cov_b, ax * s, ay * s, az * s)
    return rest * rest / variance


@njit(cache=True)
def _literal_chi2(a, b, cov_a, cov_b):
    """Chi2 (3 dof) of the whole displacement, the paper's test: (e_a - e_b)^T (C_a + C_b)^-1 (e_a - e_b)."""
    total = np.zeros((3, 3))
    for k in range(3):
        for m in range(3):
            if cov_a.shape[0] == 1:
                total[k, m] = cov_a[0] + cov_b[0] if k == m else 0.0
            else:
                total[k, m] = cov_a[3 * k + m] + cov_b[3 * k + m]
        total[k, k] *= 1.0 + 1e-9
        total[k, k] += 1e-18
    step = np.empty(3)
    for k in range(3):
        step[k] = b[k] - a[k]
    return np.sum(step * np.linalg.solve(total, step))


@njit(cache=True)
def links(points, covariance, valid, views, tangent, limit, literal):
    """Whether every point and its neighbour lie on one surface, to the right and below, shape (S, B) bool each.

    Args:
        points: shape (S, B, 3), m.
        covariance: shape (S, B, 1) or (S, B, 9), m^2.
        valid: which points are returns, shape (S, B).
        views: viewpoint of every row, shape (S, 3), m.
        tangent: of the steepest incidence at which a surface is still expected.
        limit: largest chi2: 1 degree of freedom, or 3 for the literal test.
        literal: test the whole displacement, as the paper prints it, in place of the jump in depth.
    """
    n_rows, n_cols = valid.shape
    right, down = np.zeros(valid.shape, dtype=np.bool_), np.zeros(valid.shape, dtype=np.bool_)
    for i in range(n_rows):
        for j in range(n_cols):
            if not valid[i, j]:
                continue
            a, ca = points[i, j], covariance[i, j]
            for step in range(2):
                k, m = (i, j + 1) if step == 0 else (i + 1, j)
                if k >= n_rows or m >= n_cols or not valid[k, m]:
                    continue
                b, cb = points[k, m], covariance[k, m]
                chi2 = _literal_chi2(a, b, ca, cb) if literal else _jump_chi2(a, b, ca, cb, views[i], tangent)
                if step == 0:
                    right[i, j] = chi2 <= limit
                else:
                    down[i, j] = chi2 <= limit
    return right, down


@njit(cache=True)
def surviving_quads(right, down):
    """Quads (i, j), (i, j+1), (i+1, j+1), (i+1, j) all four edges of which pass: shape (S - 1, B - 1) bool.

    References:
        Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, section IV, filter.
    """
    n_rows, n_cols = max(right.shape[0] - 1, 0), max(right.shape[1] - 1, 0)
    quads = np.zeros((n_rows, n_cols), dtype=np.bool_)
    for i in range(n_rows):
        for j in range(n_cols):
            quads[i, j] = right[i, j] and right[i + 1, j] and down[i, j] and down[i, j + 1]
    return quads
