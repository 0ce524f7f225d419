"""Numba kernels of the plane fit: one group of points at a time, nothing allocated that grows with it.

A group is ``order[lo:hi]``, indices into ``points`` (N, 3) and ``covs`` (N, 3, 3), or (1, 3, 3) with ``step`` 0 where
all points share one covariance. Coordinates are taken relative to the group before they are squared. Slopes are
b = (b0, ax, ay): the plane z = b0 + ax x + ay y of the current frame, so p = (z, theta, psi) = (b0, -ax, ay).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from spplanes._rows import COLLINEAR, COLLINEAR_RATIO, OK, ROW_SIZE, TOO_FEW, faces_viewpoint, row_frame, write_frame

#: The variance along the normal is at least this share of the trace: noise along a beam cannot vanish across a plane
#: that the beam meets at less than 1 mrad, the divergence of a laser beam.
FLOOR = 1e-6
#: Noise along the plane explains at most this share of the patch's extent; beyond, the slope is unknown anyway.
MAX_NOISE_SHARE = 0.9
#: Converged when the step promises less than this fall of chi2, i.e. moves the plane by less than 1e-5 sigma.
TOLERANCE = 1e-10
MAX_ITERATIONS = 50
#: Accumulators: cost; g (3); A (6); raw sums x, y, xx, xy, yy; noise along the plane (3); count; chi2.
COST, GRADIENT, INFORMATION, RAW, NOISE, USED, CHI2, N_SUMS = 0, 1, 4, 10, 15, 18, 19, 20


@njit(cache=True)
def start_row(points, covs, step, order, lo, hi, power, row) -> None:
    """Moment row of a group with the weights trace^-power, centred at its plain mean before anything is squared."""
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


@njit(cache=True)
def sp_covariance(points, covs, step, order, lo, hi, frame, row, values, covariance) -> float:
    """SP covariance of the weighted PCA plane, C = F diag(C_i) F^T with the exact derivative F; returns chi2.

    The fit moves by dz = sum w dz_i / W and, as the normal is an eigenvector, by the slope
    dax = sum w (x dz + z dx) / (lambda_x - lambda_z), day alike.
    """
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
def sp_group(points, covs, step, order, lo, hi, viewpoint, frame, covariance) -> tuple[int, float]:
    """The paper's fit of one group, weights 1 / trace^2: writes frame and covariance; returns outcome and chi2."""
    if hi - lo < 3:
        return TOO_FEW, 0.0
    row, values = np.empty(ROW_SIZE), np.empty(3)
    start_row(points, covs, step, order, lo, hi, 2, row)
    status = row_frame(row, viewpoint, frame, values)
    if status != OK:
        return status, 0.0
    return OK, sp_covariance(points, covs, step, order, lo, hi, frame, row, values, covariance)


@njit(cache=True)
def accumulate(points, covs, step, order, lo, hi, frame, cutoff2, sums) -> None:
    """Sums of one Gauss-Newton step of min sum rho(z_i^2 / s_i^2), s_i^2 = n^T C_i n, at the plane of ``frame``.

    The slope by which a point acts is taken at its maximum-likelihood foot point p_i - C_i n z_i / s_i^2: the gradient
    is then exact (the weights turn with the normal), so oblique noise leaves no bias. ``cutoff2`` is the square of
    Tukey's constant, infinite for plain least squares. Layout of ``sums``: see N_SUMS.
    """
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
        w = 1.0 / variance
        square = z * z * w
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
        fx, fy = x - ux * z / variance, y - uy * z / variance
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
        txx += w * (x0 * a0 + x1 * a1 + x2 * a2 - ux * ux / variance)
        txy += w * (y0 * a0 + y1 * a1 + y2 * a2 - ux * uy / variance)
        tyy += w * (y0 * b0 + y1 * b1 + y2 * b2 - uy * uy / variance)
    sums[0], sums[1], sums[2], sums[3] = cost, g0, g1, g2
    sums[4], sums[5], sums[6], sums[7], sums[8], sums[9] = h00, h01, h02, h11, h12, h22
    sums[10], sums[11], sums[12], sums[13], sums[14] = sx, sy, sxx, sxy, syy
    sums[15], sums[16], sums[17], sums[18], sums[19] = txx, txy, tyy, used, chi2


@njit(cache=True)
def invert3(a00, a01, a02, a11, a12, a22, out) -> bool:
    """Inverse of a symmetric positive definite 3x3 matrix by cofactors; False where it is not definite."""
    m00, m01, m02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    det = a00 * m00 + a01 * m01 + a02 * m02
    if not (a00 > 0.0 and m00 > 0.0 and det > 0.0):
        return False
    out[0, 0], out[0, 1], out[0, 2] = m00 / det, m01 / det, m02 / det
    out[1, 1], out[1, 2], out[2, 2] = (a00 * a22 - a02 * a02) / det, (a01 * a02 - a00 * a12) / det, 0.0
    out[2, 2] = (a00 * a11 - a01 * a01) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return True


@njit(cache=True)
def move_frame(source, b0, ax, ay, target) -> None:
    """Write to ``target`` the frame ``source`` moved onto the plane z = b0 + ax x + ay y, its x axis kept in plane."""
    length = math.sqrt(1.0 + ax * ax + ay * ay)
    normal, x = np.empty(3), np.empty(3)
    for k in range(3):
        normal[k] = (source[k, 2] - ax * source[k, 0] - ay * source[k, 1]) / length
        x[k] = source[k, 0] + ax * source[k, 2]
    along = x[0] * normal[0] + x[1] * normal[1] + x[2] * normal[2]
    for k in range(3):
        x[k] -= along * normal[k]
    size = math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    for k in range(3):
        x[k] /= size
    origin = np.empty(3)
    for k in range(3):
        origin[k] = source[k, 3] + b0 * source[k, 2]
    write_frame(normal, x, origin, target)


@njit(cache=True)
def descend(points, covs, step, order, lo, hi, cutoff2, gain, frame, sums) -> int:
    """Gauss-Newton from ``frame`` to the minimum; leaves ``frame`` there and ``sums`` taken there.

    ``gain`` stretches the step for a robust cost, whose expected curvature is below its weights' sum. A step that does
    not lower the cost is halved.
    """
    inverse, base = np.empty((3, 3)), frame.copy()
    b0 = ax = ay = 0.0
    best = np.inf
    for _ in range(MAX_ITERATIONS):
        accumulate(points, covs, step, order, lo, hi, frame, cutoff2, sums)
        if sums[0] > best * (1.0 + 1e-12) + 1e-12:
            b0, ax, ay = 0.5 * b0, 0.5 * ax, 0.5 * ay
            move_frame(base, b0, ax, ay, frame)
            continue
        if sums[18] < 3.0:
            return TOO_FEW
        if not invert3(sums[4], sums[5], sums[6], sums[7], sums[8], sums[9], inverse):
            return COLLINEAR
        best, base[:] = sums[0], frame
        g0, g1, g2 = gain * sums[1], gain * sums[2], gain * sums[3]
        b0 = inverse[0, 0] * g0 + inverse[0, 1] * g1 + inverse[0, 2] * g2
        ax = inverse[1, 0] * g0 + inverse[1, 1] * g1 + inverse[1, 2] * g2
        ay = inverse[2, 0] * g0 + inverse[2, 1] * g1 + inverse[2, 2] * g2
        if b0 * g0 + ax * g1 + ay * g2 < TOLERANCE:
            break
        move_frame(base, b0, ax, ay, frame)
    return OK


@njit(cache=True)
def noise_share(sums) -> float:
    """Share of the in-plane noise to take out of the information: 1, or less where it would eat the whole extent."""
    sxx = sums[7] - sums[5] * sums[5] / sums[4]
    sxy = sums[8] - sums[5] * sums[6] / sums[4]
    syy = sums[9] - sums[6] * sums[6] / sums[4]
    det = sxx * syy - sxy * sxy
    if det <= 0.0:
        return 0.0
    half = 0.5 * (syy * sums[15] - 2.0 * sxy * sums[16] + sxx * sums[17]) / det
    product = (sums[15] * sums[17] - sums[16] * sums[16]) / det
    largest = half + math.sqrt(max(half * half - product, 0.0))
    return min(1.0, MAX_NOISE_SHARE / largest) if largest > 0.0 else 1.0


@njit(cache=True)
def slope_covariance(sums, out) -> bool:
    """Covariance of (b0, ax, ay) at the minimum: H^-1 A H^-1, with A = sum w f f^T the score's and H the curvature's.

    H is A less the noise along the plane, by which the observed patch looks wider than it is.
    """
    share = noise_share(sums)
    if not invert3(
        sums[4],
        sums[5],
        sums[6],
        sums[7] - share * sums[15],
        sums[8] - share * sums[16],
        sums[9] - share * sums[17],
        out,
    ):
        return False
    score = np.empty((3, 3))
    score[0, 0], score[0, 1], score[0, 2] = sums[4], sums[5], sums[6]
    score[1, 0], score[1, 1], score[1, 2] = sums[5], sums[7], sums[8]
    score[2, 0], score[2, 1], score[2, 2] = sums[6], sums[8], sums[9]
    out[:] = out @ score @ out
    return True


@njit(cache=True)
def settle(base, sums, viewpoint, frame, to_p) -> int:
    """Final frame at the minimum, and the (3, 3) matrix that takes slopes in ``base`` to (z, theta, psi) in it.

    Origin at the weighted centre, x along the larger in-plane extent, normal to the viewpoint.
    """
    w = sums[4]
    cx, cy = sums[10] / w, sums[11] / w
    xx, xy, yy = sums[12] - w * cx * cx, sums[13] - w * cx * cy, sums[14] - w * cy * cy
    spread = math.hypot(0.5 * (xx - yy), xy)
    middle, largest = 0.5 * (xx + yy) - spread, 0.5 * (xx + yy) + spread
    if not middle > COLLINEAR_RATIO * COLLINEAR_RATIO * largest:
        return COLLINEAR
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    c, s = math.cos(angle), math.sin(angle)
    normal, x, centre = np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        normal[k] = base[k, 2]
        x[k] = c * base[k, 0] + s * base[k, 1]
        centre[k] = base[k, 3] + cx * base[k, 0] + cy * base[k, 1]
    if not faces_viewpoint(normal, centre, viewpoint):
        normal *= -1.0
    write_frame(normal, x, centre, frame)
    write_to_p(base, frame, cx, cy, to_p)
    return OK


@njit(cache=True)
def write_to_p(base, frame, cx, cy, to_p) -> None:
    """Matrix from (b0, ax, ay) in ``base`` to (z, theta, psi) in ``frame``, of the same plane, origin at (cx, cy)."""
    xx = xy = yx = yy = side = 0.0
    for k in range(3):
        xx += frame[k, 0] * base[k, 0]
        xy += frame[k, 0] * base[k, 1]
        yx += frame[k, 1] * base[k, 0]
        yy += frame[k, 1] * base[k, 1]
        side += frame[k, 2] * base[k, 2]
    flip = 1.0 if side > 0.0 else -1.0
    to_p[0, 0], to_p[0, 1], to_p[0, 2] = flip, flip * cx, flip * cy
    to_p[1, 0], to_p[1, 1], to_p[1, 2] = 0.0, -flip * xx, -flip * xy
    to_p[2, 0], to_p[2, 1], to_p[2, 2] = 0.0, flip * yx, flip * yy


@njit(cache=True)
def ml_group(points, covs, step, order, lo, hi, viewpoint, frame, covariance, sums) -> int:
    """Maximum-likelihood fit of one group from a PCA start; writes frame, covariance and the sums at the minimum."""
    if hi - lo < 3:
        return TOO_FEW
    row, values, base = np.empty(ROW_SIZE), np.empty(3), np.empty((4, 4))
    start_row(points, covs, step, order, lo, hi, 1, row)
    status = row_frame(row, viewpoint, base, values)
    if status != OK:
        return status
    status = descend(points, covs, step, order, lo, hi, np.inf, 1.0, base, sums)
    if status != OK:
        return status
    return finish(base, sums, viewpoint, 1.0, frame, covariance)


@njit(cache=True)
def finish(base, sums, viewpoint, factor, frame, covariance) -> int:
    """Frame and covariance from the sums at the minimum; ``factor`` is what robustness costs in variance."""
    slopes, to_p = np.empty((3, 3)), np.empty((3, 3))
    status = settle(base, sums, viewpoint, frame, to_p)
    if status != OK:
        return status
    if not slope_covariance(sums, slopes):
        return COLLINEAR
    full = to_p @ slopes @ to_p.T
    for j in range(3):
        for k in range(3):
            covariance[j, k] = 0.5 * factor * (full[j, k] + full[k, j])
    return OK
