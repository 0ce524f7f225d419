"""The quad filter: which neighbours in an organised grid lie on one surface (chi2 test on the jump in depth)."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes.segmentation._patches import variance_along


@njit(cache=True)
def _jump_chi2(a, b, cov_a, cov_b, view, tangent):
    """Chi2 (1 dof) of the step in depth that no surface seen at less than the steepest incidence explains."""
    ax, ay, az = a[0] - view[0], a[1] - view[1], a[2] - view[2]
    bx, by, bz = b[0] - view[0], b[1] - view[1], b[2] - view[2]
    ra, rb = np.sqrt(ax * ax + ay * ay + az * az), np.sqrt(bx * bx + by * by + bz * bz)
    if ra == 0.0 or rb == 0.0:
        return np.inf
    ax, ay, az, bx, by, bz = ax / ra, ay / ra, az / ra, bx / rb, by / rb, bz / rb
    angle = np.sqrt((ax - bx) ** 2 + (ay - by) ** 2 + (az - bz) ** 2)
    rest = abs(ra - rb) - min(ra, rb) * angle * tangent
    if rest <= 0.0:
        return 0.0
    return rest * rest / (variance_along(cov_a, ax, ay, az) + variance_along(cov_b, bx, by, bz))


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
