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
def links(points, covariance, valid, views, tangent, limit):
    """Links to the right and downward neighbour, shape (S, B) bool each; the last column or row stays False."""
    n_rows, n_cols = valid.shape
    right, down = np.zeros(valid.shape, dtype=np.bool_), np.zeros(valid.shape, dtype=np.bool_)
    for i in range(n_rows):
        for j in range(n_cols):
            if not valid[i, j]:
                continue
            a, ca = points[i, j], covariance[i, j]
            if j + 1 < n_cols and valid[i, j + 1]:
                right[i, j] = _jump_chi2(a, points[i, j + 1], ca, covariance[i, j + 1], views[i], tangent) <= limit
            if i + 1 < n_rows and valid[i + 1, j]:
                down[i, j] = _jump_chi2(a, points[i + 1, j], ca, covariance[i + 1, j], views[i], tangent) <= limit
    return right, down
