"""Numba kernels of the plane fit of one group of points: descent, final frame, covariance.

Slopes are b = (b0, ax, ay): the plane z = b0 + ax x + ay y of the current frame. (z, theta, psi) is (b0, -ax, ay).
For the meaning of a group's arguments and the layout of the sums see ``_sums``.
"""

from __future__ import annotations

import math

import numpy as np

from spplanes._jit import inlined, inner, njit
from spplanes._rows import (
    COLLINEAR,
    COLLINEAR_RATIO,
    OK,
    ROW_SIZE,
    TOO_FEW,
    column,
    copy_into,
    dot,
    faces_viewpoint,
    over,
    row_frame,
    symmetric3,
    times,
    write_frame,
)
from spplanes.fitting._sums import USED, accumulate, sp_covariance, start_row

#: Noise along the plane explains at most this share of the patch's extent; beyond, the slope is unknown anyway.
MAX_NOISE_SHARE = 0.9
#: The last step promises less than this fall of chi2, i.e. moves the plane by less than 1e-3 sigma. Steps shrink by
#: more than a hundred each, so what is left after it is nothing, and the sums taken before it are as good as after.
TOLERANCE = 1e-6
MAX_ITERATIONS = 50


@inner(cache=True)
def sp_group(group, viewpoint, frame, covariance) -> tuple[int, float]:
    """The paper's fit of one group, weights 1 / trace^2: writes frame and covariance; returns outcome and chi2."""
    row, values = np.empty(ROW_SIZE), np.empty(3)
    start_row(group, 2, row)
    status = row_frame(row, viewpoint, frame, values)
    if status != OK:
        return status, 0.0
    return OK, sp_covariance(group, frame, row, values, covariance)


@njit(cache=True)
def invert3(upper, out) -> bool:
    """Inverse of the matrix with this upper triangle, (6,), by cofactors; False where it is not positive definite."""
    a00, a01, a02, a11, a12, a22 = upper[0], upper[1], upper[2], upper[3], upper[4], upper[5]
    m00, m01, m02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    det = a00 * m00 + a01 * m01 + a02 * m02
    if not (a00 > 0.0 and m00 > 0.0 and det > 0.0):
        return False
    out[0, 0], out[0, 1], out[0, 2] = m00 / det, m01 / det, m02 / det
    out[1, 1], out[1, 2], out[2, 2] = (a00 * a22 - a02 * a02) / det, (a01 * a02 - a00 * a12) / det, 0.0
    out[2, 2] = (a00 * a11 - a01 * a01) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return True


@inner(cache=True)
def multiply3(a, b, out) -> None:
    """Product of two 3x3 matrices; for so small ones a call of BLAS takes longer."""
    for j in range(3):
        for k in range(3):
            out[j, k] = a[j, 0] * b[0, k] + a[j, 1] * b[1, k] + a[j, 2] * b[2, k]


@njit(cache=True)
def move_frame(source, slopes, target) -> None:
    """Write to ``target`` the frame ``source`` moved onto the plane z = b0 + ax x + ay y, its x axis kept in plane."""
    b0, ax, ay = slopes
    length = math.sqrt(1.0 + ax * ax + ay * ay)
    normal, x, origin = np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        normal[k] = (source[k, 2] - ax * source[k, 0] - ay * source[k, 1]) / length
        x[k] = source[k, 0] + ax * source[k, 2]
        origin[k] = source[k, 3] + b0 * source[k, 2]
    along = dot(x, normal)
    for k in range(3):
        x[k] -= along * normal[k]
    write_frame(normal, over(x, math.sqrt(dot(x, x))), origin, target)


@inner(cache=True)
def descend(group, cutoff2, gain, frame, sums) -> int:
    """Gauss-Newton from ``frame`` to the minimum; leaves ``frame`` there and ``sums`` as good as taken there. ``gain``
    stretches the step for a robust cost, whose expected curvature is below its weights' sum. A step that does not lower
    the cost is halved."""
    inverse, base = np.empty((3, 3)), frame.copy()
    step, best = (0.0, 0.0, 0.0), np.inf
    for _ in range(MAX_ITERATIONS):
        accumulate(group, frame, cutoff2, sums)
        if sums[0] > best * (1.0 + 1e-12) + 1e-12:
            step = 0.5 * step[0], 0.5 * step[1], 0.5 * step[2]
            move_frame(base, step, frame)
            continue
        if sums[USED] < 3.0:
            return TOO_FEW
        if not invert3(sums[4:10], inverse):
            return COLLINEAR
        best = sums[0]
        copy_into(base, frame)
        gradient = gain * sums[1], gain * sums[2], gain * sums[3]
        step = times(inverse, gradient)
        move_frame(base, step, frame)
        if dot(step, gradient) < TOLERANCE:
            break
    return OK


@inlined
def noise_share(sums) -> float:
    """Share of the in-plane noise to take out of the information: less than 1 where it would eat the whole extent.
    About their own centre, n points look wider by the noise of n - 1."""
    sxx = sums[7] - sums[5] * sums[5] / sums[4]
    sxy = sums[8] - sums[5] * sums[6] / sums[4]
    syy = sums[9] - sums[6] * sums[6] / sums[4]
    det = sxx * syy - sxy * sxy
    whole = 1.0 - 1.0 / sums[USED]
    if det <= 0.0:
        return 0.0
    half = 0.5 * (syy * sums[15] - 2.0 * sxy * sums[16] + sxx * sums[17]) / det
    product = (sums[15] * sums[17] - sums[16] * sums[16]) / det
    largest = half + math.sqrt(max(half * half - product, 0.0))
    return min(whole, MAX_NOISE_SHARE / largest) if largest > 0.0 else whole


@njit(cache=True)
def write_covariance(sums, score, to_p, covariance) -> int:
    """Write the covariance of (z, theta, psi) at the minimum, H^-1 J H^-1 of the slopes; the outcome.

    H is the information in ``sums`` less the noise along the plane, by which the observed patch looks wider than it is.
    J, the variance of the score, is given by its upper triangle, shape (6,); it is the information itself in the plain
    fit. ``to_p`` takes slopes to (z, theta, psi).
    """
    share = noise_share(sums)
    information, inverse, middle, product = sums[4:10].copy(), np.empty((3, 3)), symmetric3(score), np.empty((3, 3))
    for k in range(3):
        information[3 + k] -= share * sums[15 + k]
    if not invert3(information, inverse):
        return COLLINEAR
    multiply3(to_p, inverse, product)
    multiply3(product, middle, inverse)
    multiply3(inverse, product.T, middle)
    for j in range(3):
        for k in range(3):
            covariance[j, k] = 0.5 * (middle[j, k] + middle[k, j])
    return OK


@njit(cache=True)
def settle(base, sums, viewpoint, frame, to_p) -> int:
    """Final frame at the minimum, and the (3, 3) matrix that takes slopes in ``base`` to (z, theta, psi) in it. Origin
    at the weighted centre, x along the larger in-plane extent, normal to the viewpoint."""
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
        for k in range(3):
            normal[k] = -normal[k]
    write_frame(normal, x, centre, frame)
    write_to_p(base, frame, cx, cy, to_p)
    return OK


@inlined
def write_to_p(base, frame, cx, cy, to_p) -> None:
    """Matrix from (b0, ax, ay) in ``base`` to (z, theta, psi) in ``frame``, of the same plane, origin at (cx, cy)."""
    x, y = column(frame, 0), column(frame, 1)
    flip = 1.0 if dot(column(frame, 2), column(base, 2)) > 0.0 else -1.0
    to_p[0, 0], to_p[0, 1], to_p[0, 2] = flip, flip * cx, flip * cy
    to_p[1, 0], to_p[2, 0] = 0.0, 0.0
    for k in range(2):
        slope_axis = column(base, k)
        to_p[1, k + 1], to_p[2, k + 1] = -flip * dot(x, slope_axis), flip * dot(y, slope_axis)


@inner(cache=True)
def ml_group(group, viewpoint, frame, covariance, sums) -> int:
    """Maximum-likelihood fit of one group from a PCA start; writes frame, covariance and the sums at the minimum."""
    row, values, base = np.empty(ROW_SIZE), np.empty(3), np.empty((4, 4))
    start_row(group, 1, row)
    status = row_frame(row, viewpoint, base, values)
    if status != OK:
        return status
    status, to_p = descend(group, np.inf, 1.0, base, sums), np.empty((3, 3))
    if status == OK:
        status = settle(base, sums, viewpoint, frame, to_p)
    return write_covariance(sums, sums[4:10], to_p, covariance) if status == OK else status
