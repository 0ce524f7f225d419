"""Fast kernels on moment rows (see ``spplanes.moments``) for the many small decisions of the segmentation.

Planes that leave the segmentation are fitted with the accurate ones of ``spplanes.moments``.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True)
def merge_scaled(out, a, scale_a, b, scale_b):
    """Write the moments of both rows together into out, the weights of each multiplied by its scale."""
    wa, wb = a[1] * scale_a, b[1] * scale_b
    total = wa + wb
    out[0] = a[0] + b[0]
    out[1] = total
    dx, dy, dz = b[2] - a[2], b[3] - a[3], b[4] - a[4]
    share = wb / total
    k = wa * share
    out[2] = a[2] + share * dx
    out[3] = a[3] + share * dy
    out[4] = a[4] + share * dz
    out[5] = a[5] * scale_a + b[5] * scale_b + k * dx * dx
    out[6] = a[6] * scale_a + b[6] * scale_b + k * dx * dy
    out[7] = a[7] * scale_a + b[7] * scale_b + k * dx * dz
    out[8] = a[8] * scale_a + b[8] * scale_b + k * dy * dy
    out[9] = a[9] * scale_a + b[9] * scale_b + k * dy * dz
    out[10] = a[10] * scale_a + b[10] * scale_b + k * dz * dz


@njit(cache=True)
def eigenvalues(row):
    """Eigenvalues of the scatter, ascending (trigonometric solution of the characteristic polynomial)."""
    a, b, c, d, e, f = row[5], row[6], row[7], row[8], row[9], row[10]
    off = b * b + c * c + e * e
    mean = (a + d + f) / 3.0
    if off == 0.0 and a == d and d == f:
        return mean, mean, mean
    aa, dd, ff = a - mean, d - mean, f - mean
    p = np.sqrt((aa * aa + dd * dd + ff * ff + 2.0 * off) / 6.0)
    det = aa * (dd * ff - e * e) - b * (b * ff - c * e) + c * (b * e - c * dd)
    half = min(1.0, max(-1.0, det / (2.0 * p * p * p)))
    angle = np.arccos(half) / 3.0
    largest = mean + 2.0 * p * np.cos(angle)
    smallest = mean + 2.0 * p * np.cos(angle + 2.0943951023931953)
    return max(smallest, 0.0), max(3.0 * mean - largest - smallest, 0.0), largest


@njit(cache=True)
def normal_of(row, smallest):
    """Unit eigenvector of the scatter for its smallest eigenvalue: the longest cross product of two rows of S - l I."""
    a, b, c = row[5] - smallest, row[6], row[7]
    d, e, f = row[8] - smallest, row[9], row[10] - smallest
    ux, uy, uz = b * e - c * d, c * b - a * e, a * d - b * b
    vx, vy, vz = b * f - c * e, c * c - a * f, a * e - b * c
    wx, wy, wz = d * f - e * e, e * c - b * f, b * e - d * c
    u, v, w = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    if v > u and v >= w:
        ux, uy, uz, u = vx, vy, vz, v
    elif w > u:
        ux, uy, uz, u = wx, wy, wz, w
    if u == 0.0:
        return 0.0, 0.0, 1.0
    s = 1.0 / np.sqrt(u)
    return ux * s, uy * s, uz * s


@njit(cache=True)
def variance_along(covariance, nx, ny, nz):
    """n^T C n of one point; covariance holds one isotropic variance or nine entries.

    It is not taken below a thousandth of the trace: a beam that grazes a plane does not measure it exactly, even if the
    model leaves out the error of its direction.
    """
    if covariance.shape[0] == 1:
        return covariance[0]
    along = (
        nx * (covariance[0] * nx + (covariance[1] + covariance[3]) * ny + (covariance[2] + covariance[6]) * nz)
        + ny * (covariance[4] * ny + (covariance[5] + covariance[7]) * nz)
        + nz * nz * covariance[8]
    )
    return max(along, 1e-3 * (covariance[0] + covariance[4] + covariance[8]))
