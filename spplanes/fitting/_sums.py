"""Numba kernels that walk over the points of one group and sum up what a plane fit needs; nothing is allocated.

A group is (points, covs, step, order, lo, hi): ``order[lo:hi]``, indices into ``points`` (N, 3) and ``covs`` (N, 3, 3),
or (1, 3, 3) with ``step`` 0 where all points share one covariance. Coordinates are taken relative to the group before
they are squared. They are written out in scalars: that is several times as fast as small arrays.
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, njit

#: The variance along the normal is at least this share of the trace: noise along a beam cannot vanish across a plane
#: that the beam meets at less than 1 mrad, the divergence of a laser beam.
FLOOR = 1e-6
#: Layout of the sums: cost; gradient (3); information (6); raw sums of w times x, y, xx, xy, yy; noise along the plane
#: (3); number of points used; chi2.
INFORMATION, RAW, USED, CHI2, N_SUMS = 4, 10, 18, 19, 20


@njit(cache=True)
def start_row(group, power, row) -> None:
    """Moment row of a group with the weights trace^-power, centred at its plain mean before anything is squared."""
    points, covs, step, order, lo, hi = group
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
        c = covs[i * step]
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
    row[5], row[6], row[7] = xx - total * sx * sx, xy - total * sx * sy, xz - total * sx * sz
    row[8], row[9], row[10] = yy - total * sy * sy, yz - total * sy * sz, zz - total * sz * sz


@inlined
def sp_covariance(group, frame, row, values, covariance) -> float:
    """SP covariance of the weighted PCA plane, C = F diag(C_i) F^T with the exact derivative F; returns chi2. The fit
    moves by dz = sum w dz_i / W and, as the normal is an eigenvector, by the slope dax = sum w (x dz + z dx) /
    (lambda_x - lambda_z), day alike."""
    points, covs, step, order, lo, hi = group
    x0, x1, x2 = frame[0, 0], frame[1, 0], frame[2, 0]
    y0, y1, y2 = frame[0, 1], frame[1, 1], frame[2, 1]
    n0, n1, n2 = frame[0, 2], frame[1, 2], frame[2, 2]
    ox, oy, oz = frame[0, 3], frame[1, 3], frame[2, 3]
    s00 = s01 = s02 = s11 = s12 = s22 = chi2 = 0.0
    for k in range(lo, hi):
        i = order[k]
        c = covs[i * step]
        q0, q1, q2 = points[i, 0] - ox, points[i, 1] - oy, points[i, 2] - oz
        x = x0 * q0 + x1 * q1 + x2 * q2
        y = y0 * q0 + y1 * q1 + y2 * q2
        z = n0 * q0 + n1 * q1 + n2 * q2
        trace = c[0, 0] + c[1, 1] + c[2, 2]
        w = 1.0 / (trace * trace)
        a0, a1, a2 = x * n0 + z * x0, x * n1 + z * x1, x * n2 + z * x2
        b0, b1, b2 = y * n0 + z * y0, y * n1 + z * y1, y * n2 + z * y2
        u0 = c[0, 0] * n0 + c[0, 1] * n1 + c[0, 2] * n2
        u1 = c[0, 1] * n0 + c[1, 1] * n1 + c[1, 2] * n2
        u2 = c[0, 2] * n0 + c[1, 2] * n1 + c[2, 2] * n2
        v0 = c[0, 0] * a0 + c[0, 1] * a1 + c[0, 2] * a2
        v1 = c[0, 1] * a0 + c[1, 1] * a1 + c[1, 2] * a2
        v2 = c[0, 2] * a0 + c[1, 2] * a1 + c[2, 2] * a2
        t0 = c[0, 0] * b0 + c[0, 1] * b1 + c[0, 2] * b2
        t1 = c[0, 1] * b0 + c[1, 1] * b1 + c[1, 2] * b2
        t2 = c[0, 2] * b0 + c[1, 2] * b1 + c[2, 2] * b2
        variance = n0 * u0 + n1 * u1 + n2 * u2
        w2 = w * w
        s00 += w2 * variance
        s01 += w2 * (a0 * u0 + a1 * u1 + a2 * u2)
        s02 += w2 * (b0 * u0 + b1 * u1 + b2 * u2)
        s11 += w2 * (a0 * v0 + a1 * v1 + a2 * v2)
        s12 += w2 * (b0 * v0 + b1 * v1 + b2 * v2)
        s22 += w2 * (b0 * t0 + b1 * t1 + b2 * t2)
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
    points, covs, step, order, lo, hi = group
    x0, x1, x2 = frame[0, 0], frame[1, 0], frame[2, 0]
    y0, y1, y2 = frame[0, 1], frame[1, 1], frame[2, 1]
    n0, n1, n2 = frame[0, 2], frame[1, 2], frame[2, 2]
    ox, oy, oz = frame[0, 3], frame[1, 3], frame[2, 3]
    robust = cutoff2 < np.inf
    cost = g0 = g1 = g2 = h00 = h01 = h02 = h11 = h12 = h22 = 0.0
    sx = sy = sxx = sxy = syy = txx = txy = tyy = used = chi2 = 0.0
    for k in range(lo, hi):
        i = order[k]
        c = covs[i * step]
        q0, q1, q2 = points[i, 0] - ox, points[i, 1] - oy, points[i, 2] - oz
        x = x0 * q0 + x1 * q1 + x2 * q2
        y = y0 * q0 + y1 * q1 + y2 * q2
        z = n0 * q0 + n1 * q1 + n2 * q2
        c00, c01, c02, c11, c12, c22 = c[0, 0], c[0, 1], c[0, 2], c[1, 1], c[1, 2], c[2, 2]
        u0 = c00 * n0 + c01 * n1 + c02 * n2
        u1 = c01 * n0 + c11 * n1 + c12 * n2
        u2 = c02 * n0 + c12 * n1 + c22 * n2
        variance = n0 * u0 + n1 * u1 + n2 * u2
        ux, uy = x0 * u0 + x1 * u1 + x2 * u2, y0 * u0 + y1 * u1 + y2 * u2
        least = FLOOR * (c00 + c11 + c22)
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
        a0 = c00 * x0 + c01 * x1 + c02 * x2
        a1 = c01 * x0 + c11 * x1 + c12 * x2
        a2 = c02 * x0 + c12 * x1 + c22 * x2
        b0 = c00 * y0 + c01 * y1 + c02 * y2
        b1 = c01 * y0 + c11 * y1 + c12 * y2
        b2 = c02 * y0 + c12 * y1 + c22 * y2
        txx += w * (x0 * a0 + x1 * a1 + x2 * a2 - ux * ux * inverse)
        txy += w * (y0 * a0 + y1 * a1 + y2 * a2 - ux * uy * inverse)
        tyy += w * (y0 * b0 + y1 * b1 + y2 * b2 - uy * uy * inverse)
    sums[0], sums[1], sums[2], sums[3] = cost, g0, g1, g2
    sums[4], sums[5], sums[6], sums[7], sums[8], sums[9] = h00, h01, h02, h11, h12, h22
    sums[10], sums[11], sums[12], sums[13], sums[14] = sx, sy, sxx, sxy, syy
    sums[15], sums[16], sums[17], sums[18], sums[19] = txx, txy, tyy, used, chi2
