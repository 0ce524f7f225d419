"""Numba kernels that walk over the points of one group and sum up what a plane fit needs; nothing is allocated.

A group is (points, covs, order, lo, hi): ``order[lo:hi]``, indices into ``points`` (N, 3) and ``covs`` (N, 3, 3), or
(1, 3, 3) where all points share one covariance. Coordinates are taken relative to the group before they are squared.
Vectors are tuples, and sums scalars: that is several times as fast as small arrays.
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, njit
from spplanes._rows import add_square, column, dot, in_frame, times

#: The variance along the normal is at least this share of the trace: noise along a beam cannot vanish across a plane
#: that the beam meets at less than 1 mrad, the divergence of a laser beam.
FLOOR = 1e-6
#: Layout of the sums: cost; gradient (3); from 4 on information (6); from 10 on raw sums of w times x, y, xx, xy, yy;
#: from 15 on noise along the plane (3); number of points used; chi2; so many numbers.
USED, CHI2, N_SUMS = 18, 19, 20


@njit(cache=True)
def start_row(group, power, row) -> None:
    """Moment row of a group with the weights trace^-power, centred at its plain mean before anything is squared."""
    points, covs, order, lo, hi = group
    ox, oy, oz = points[order[lo], 0], points[order[lo], 1], points[order[lo], 2]
    mx = my = mz = 0.0
    for k in range(lo, hi):
        i = order[k]
        mx += points[i, 0] - ox
        my += points[i, 1] - oy
        mz += points[i, 2] - oz
    n = hi - lo
    ox, oy, oz = ox + mx / n, oy + my / n, oz + mz / n
    total = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for k in range(lo, hi):
        i = order[k]
        c = covs[min(i, covs.shape[0] - 1)]
        w = 1.0 / (c[0, 0] + c[1, 1] + c[2, 2])
        if power == 2:
            w *= w
        x, y, z = points[i, 0] - ox, points[i, 1] - oy, points[i, 2] - oz
        total += w
        sx += w * x
        sy += w * y
        sz += w * z
        xx += w * x * x
        xy += w * x * y
        xz += w * x * z
        yy += w * y * y
        yz += w * y * z
        zz += w * z * z
    sx, sy, sz = sx / total, sy / total, sz / total
    row[0], row[1], row[2], row[3], row[4] = n, total, ox + sx, oy + sy, oz + sz
    row[5], row[6], row[7], row[8], row[9], row[10] = xx, xy, xz, yy, yz, zz
    add_square(row[5:], -total, (sx, sy, sz))


@inlined
def sp_covariance(group, frame, row, values, covariance) -> float:
    """SP covariance of the weighted PCA plane, C = F diag(C_i) F^T with the exact derivative F; returns chi2. The fit
    moves by dz = sum w dz_i / W and, as the normal is an eigenvector, by the slope dax = sum w (x dz + z dx) /
    (lambda_x - lambda_z), day alike."""
    points, covs, order, lo, hi = group
    x_axis, y_axis, n = column(frame, 0), column(frame, 1), column(frame, 2)
    s00 = s01 = s02 = s11 = s12 = s22 = chi2 = 0.0
    for k in range(lo, hi):
        i = order[k]
        c = covs[min(i, covs.shape[0] - 1)]
        x, y, z = in_frame(points, i, frame)
        trace = c[0, 0] + c[1, 1] + c[2, 2]
        w = 1.0 / (trace * trace)
        a = x * n[0] + z * x_axis[0], x * n[1] + z * x_axis[1], x * n[2] + z * x_axis[2]
        b = y * n[0] + z * y_axis[0], y * n[1] + z * y_axis[1], y * n[2] + z * y_axis[2]
        by_n, by_a, by_b = times(c, n), times(c, a), times(c, b)
        variance = dot(n, by_n)
        w2 = w * w
        s00 += w2 * variance
        s01 += w2 * dot(a, by_n)
        s02 += w2 * dot(b, by_n)
        s11 += w2 * dot(a, by_a)
        s12 += w2 * dot(b, by_a)
        s22 += w2 * dot(b, by_b)
        chi2 += z * z / max(variance, FLOOR * trace)
    f0, f1, f2 = 1.0 / row[1], -1.0 / (values[2] - values[0]), 1.0 / (values[1] - values[0])
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = f0 * f0 * s00, f1 * f1 * s11, f2 * f2 * s22
    covariance[0, 1] = covariance[1, 0] = f0 * f1 * s01
    covariance[0, 2] = covariance[2, 0] = f0 * f2 * s02
    covariance[1, 2] = covariance[2, 1] = f1 * f2 * s12
    return chi2


@njit(cache=True)
def accumulate(group, frame, cutoff2, sums) -> None:
    """Sums of one Gauss-Newton step of min sum rho(z_i^2 / s_i^2), s_i^2 = n^T C_i n, at the plane of ``frame``.

    The slope by which a point acts is taken at its maximum-likelihood foot point p_i - C_i n z_i / s_i^2: the gradient
    is then exact (the weights turn with the normal), so oblique noise leaves no bias. ``cutoff2`` is the square of
    Tukey's constant, infinite for plain least squares. Layout of ``sums``: see N_SUMS.
    """
    points, covs, order, lo, hi = group
    x_axis, y_axis, n = column(frame, 0), column(frame, 1), column(frame, 2)
    robust = cutoff2 < np.inf
    cost = g0 = g1 = g2 = h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    sx = sy = sxx = sxy = syy = txx = txy = tyy = used = chi2 = 0.0
    for k in range(lo, hi):
        i = order[k]
        c = covs[min(i, covs.shape[0] - 1)]
        x, y, z = in_frame(points, i, frame)
        by_n = times(c, n)
        variance, ux, uy = dot(n, by_n), dot(x_axis, by_n), dot(y_axis, by_n)
        least = FLOOR * (c[0, 0] + c[1, 1] + c[2, 2])
        if variance < least:
            variance, ux, uy = least, 0.0, 0.0
        inverse = 1.0 / variance
        w, square = inverse, z * z * inverse
        if robust:
            keep = 1.0 - square / cutoff2
            if keep <= 0.0:
                cost += cutoff2 / 3.0
                continue
            cost += cutoff2 / 3.0 * (1.0 - keep * keep * keep)
            w *= keep * keep
        else:
            cost += square
        used += 1.0
        chi2 += square
        fx, fy = x - ux * z * inverse, y - uy * z * inverse
        g0 += w * z
        g1 += w * z * fx
        g2 += w * z * fy
        h00 += w
        h01 += w * fx
        h02 += w * fy
        h11 += w * fx * fx
        h12 += w * fx * fy
        h22 += w * fy * fy
        sx += w * x
        sy += w * y
        sxx += w * x * x
        sxy += w * x * y
        syy += w * y * y
        by_x, by_y = times(c, x_axis), times(c, y_axis)
        txx += w * (dot(x_axis, by_x) - ux * ux * inverse)
        txy += w * (dot(y_axis, by_x) - ux * uy * inverse)
        tyy += w * (dot(y_axis, by_y) - uy * uy * inverse)
    sums[0], sums[1], sums[2], sums[3] = cost, g0, g1, g2
    sums[4], sums[5], sums[6], sums[7], sums[8], sums[9] = h00, h01, h02, h11, h12, h22
    sums[10], sums[11], sums[12], sums[13], sums[14] = sx, sy, sxx, sxy, syy
    sums[15], sums[16], sums[17], sums[18], sums[19] = txx, txy, tyy, used, chi2
