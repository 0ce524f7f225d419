"""Fast kernels on moment rows (see ``spplanes.moments``) for the many small decisions of the segmentation.

Planes that leave the segmentation are fitted with the accurate ones of ``spplanes.moments``.
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inner, njit
from spplanes._rows import add_square, over


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
def variance_along(covariance, i, j, nx, ny, nz):
    """n^T C n of point (i, j) of a grid of covariances, (S, B, 1), isotropic variances, or (S, B, 9): by index, because
    a view of every single point would take longer than the arithmetic. It is not taken below a thousandth of the trace:
    a beam that grazes a plane does not measure it exactly, even if the model leaves out the error of its direction."""
    if covariance.shape[2] == 1:
        return covariance[i, j, 0]
    xx, yy, zz = covariance[i, j, 0], covariance[i, j, 4], covariance[i, j, 8]
    xy, xz = covariance[i, j, 1] + covariance[i, j, 3], covariance[i, j, 2] + covariance[i, j, 6]
    yz = covariance[i, j, 5] + covariance[i, j, 7]
    along = nx * (xx * nx + xy * ny + xz * nz) + ny * (yy * ny + yz * nz) + nz * nz * zz
    return max(along, 1e-3 * (xx + yy + zz))


@inner(cache=True)
def distance_of(points, i, j, planes, r):
    """Signed distance of point (i, j) from plane r of (normal, d), shape (R, 4), m."""
    return (
        points[i, j, 0] * planes[r, 0] + points[i, j, 1] * planes[r, 1] + points[i, j, 2] * planes[r, 2] - planes[r, 3]
    )


@inner(cache=True)
def variance_from(covariance, i, j, planes, r):
    """Variance of point (i, j) along the normal of plane r, m^2."""
    return variance_along(covariance, i, j, planes[r, 0], planes[r, 1], planes[r, 2])


@inner(cache=True)
def residual_chi2(points, covariance, i, j, planes, r, floor_variance):
    """Squared distance of point (i, j) from plane r by its variance along the normal (1 dof)."""
    distance = distance_of(points, i, j, planes, r)
    return distance * distance / (variance_from(covariance, i, j, planes, r) + floor_variance)


@inner(cache=True)
def add_run(sums, points, covariance, i, begin, end, about, normal, floor_variance, weighted):
    """Add points [begin, end) of row i to sums about a point near them, weighted by their noise along a normal. Sums in
    registers, row by row, take a third of the time of adding every point to moments."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    ox, oy, oz = about[0], about[1], about[2]
    sw, sx, sy, sz, xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(begin, end):
        w = 1.0 / (variance_along(covariance, i, j, nx, ny, nz) + floor_variance) if weighted else 1.0
        x, y, z = points[i, j, 0] - ox, points[i, j, 1] - oy, points[i, j, 2] - oz
        wx, wy, wz = w * x, w * y, w * z
        sw, sx, sy, sz = sw + w, sx + wx, sy + wy, sz + wz
        xx, xy, xz = xx + wx * x, xy + wx * y, xz + wx * z
        yy, yz, zz = yy + wy * y, yz + wy * z, zz + wz * z
    added = float(end - begin), sw, sx, sy, sz, xx, xy, xz, yy, yz, zz
    for k in range(11):
        sums[k] += added[k]


@inner(cache=True)
def centre_sums(sums, about):
    """Turn sums about a point into moments about their own centre, in place."""
    x, y, z = over(sums[2:5], sums[1])
    add_square(sums[5:], -sums[1], (x, y, z))
    sums[2], sums[3], sums[4] = about[0] + x, about[1] + y, about[2] + z
