"""Kernels of line extraction: the maximum-likelihood line of a set of beams, its ends, and how straight it is."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner
from spplanes.lines._round import solve_symmetric

#: Gauss-Newton ends with a step that lowers chi2 by less than this: a thousandth of a standard deviation.
STEP_TOLERANCE = 1e-6
MAX_STEPS = 20
#: A line grows only where it predicts the range with at most this many times the variance of a beam.
MAX_PREDICTION = 5.0


@inlined
def normal_equations(cosines, sines, ranges, sigmas, members, alpha, rho):
    """Of the range residuals e: information sum J J^T / sigma^2 (3 entries), gradient sum J e / sigma^2 (2), chi2.

    J is the derivative of the range rho / cos(a - alpha) by (alpha, rho): (-rho sin / cos^2, 1 / cos). Cosines and
    sines are those of the bearings; those of a - alpha follow without another call for every beam.
    """
    i00 = i01 = i11 = g0 = g1 = chi2 = 0.0
    nx, ny = np.cos(alpha), np.sin(alpha)
    for k in members:
        c, s = cosines[k] * nx + sines[k] * ny, sines[k] * nx - cosines[k] * ny
        by_rho = 1.0 / (c * sigmas[k])
        by_alpha = -rho * s / c * by_rho
        error = ranges[k] / sigmas[k] - rho * by_rho
        i00, i01, i11 = i00 + by_alpha * by_alpha, i01 + by_alpha * by_rho, i11 + by_rho * by_rho
        g0, g1, chi2 = g0 + by_alpha * error, g1 + by_rho * error, chi2 + error * error
    return i00, i01, i11, g0, g1, chi2


@inner(cache=True)
def fit_beams(cosines, sines, ranges, sigmas, members, alpha, rho):
    """Gauss-Newton from (alpha, rho): (alpha, rho, var alpha, cov, var rho, chi2); chi2 = inf: it did not converge."""
    for _ in range(MAX_STEPS):
        i00, i01, i11, g0, g1, chi2 = normal_equations(cosines, sines, ranges, sigmas, members, alpha, rho)
        det = i00 * i11 - i01 * i01
        if not det > 1e-13 * i00 * i11:
            break
        d0, d1 = (i11 * g0 - i01 * g1) / det, (i00 * g1 - i01 * g0) / det
        alpha, rho = alpha + d0, rho + d1
        if not rho > 0.0:
            break
        if d0 * g0 + d1 * g1 < STEP_TOLERANCE:
            return alpha, rho, i11 / det, -i01 / det, i00 / det, chi2
    return alpha, rho, 0.0, 0.0, 0.0, np.inf


@inlined
def line_sigmas(bearings, sigmas, alpha, rho, bearing_sigma):
    """`sigmas` with the bearing noise in them: the range of the line changes by rho sin / cos^2."""
    result = np.empty(sigmas.size)
    for k in range(sigmas.size):
        c, s = np.cos(bearings[k] - alpha), np.sin(bearings[k] - alpha)
        result[k] = np.hypot(sigmas[k], bearing_sigma * rho * s / (c * c))
    return result


@inlined
def belongs(bearing, r, sigma, line, gate):
    """True when a beam next to the line is on it: chi2 under `gate`, where the line predicts its range well."""
    alpha, rho, v00, v01, v11, _ = line
    c, s = np.cos(bearing - alpha), np.sin(bearing - alpha)
    if c <= 0.0:
        return False
    by_alpha, by_rho = -rho * s / (c * c), 1.0 / c
    variance = sigma * sigma + by_alpha * by_alpha * v00 + 2.0 * by_alpha * by_rho * v01 + by_rho * by_rho * v11
    return variance < MAX_PREDICTION * sigma * sigma and (r - rho / c) ** 2 < gate * variance


@inner(cache=True)
def trim(bearings, ranges, sigmas, members, line, gate):
    """Members without the end beams that do not belong to the line."""
    low, high = 0, members.size
    while high - low > 2 and misses(bearings, ranges, sigmas, members[low], line, gate):
        low += 1
    while high - low > 2 and misses(bearings, ranges, sigmas, members[high - 1], line, gate):
        high -= 1
    return members[low:high]


@inlined
def misses(bearings, ranges, sigmas, k, line, gate):
    """True when beam k, already on the line, is farther from it than its noise allows."""
    return (ranges[k] - line[1] / np.cos(bearings[k] - line[0])) ** 2 > gate * sigmas[k] ** 2


@inner(cache=True)
def grow(bearings, ranges, sigmas, breaks, labels, members, line, gate):
    """Members with the free beams next to both ends that belong to the line."""
    low, high = members[0], members[-1] + 1
    while low > 0 and breaks[low] < 2 and labels[low - 1] < 0:
        if not belongs(bearings[low - 1], ranges[low - 1], sigmas[low - 1], line, gate):
            break
        low -= 1
    while high < bearings.size and breaks[high] < 2 and labels[high] < 0:
        if not belongs(bearings[high], ranges[high], sigmas[high], line, gate):
            break
        high += 1
    before, after = members[0] - low, high - members[-1] - 1
    grown = np.empty(before + members.size + after, dtype=np.int64)
    for k in range(before):
        grown[k] = low + k
    for k in range(members.size):
        grown[before + k] = members[k]
    for k in range(after):
        grown[grown.size - after + k] = high - after + k
    return grown


@inlined
def relabel(labels, members, label):
    """Give beams a label, in place."""
    for k in members:
        labels[k] = label


@inlined
def turning(bearings, cosines, sines, ranges, sigmas, members, line):
    """Angle, rad, by which the beams turn from end to end if they are an arc, and its standard deviation.

    The second-order coefficient of the normal residual over 1, t, t^2 with t in [-1, 1] is the sagitta.
    """
    alpha, rho = line[0], line[1]
    first, last = rho * np.tan(bearings[members[0]] - alpha), rho * np.tan(bearings[members[-1]] - alpha)
    half, middle = 0.5 * (last - first), 0.5 * (last + first)
    w0 = w1 = w2 = w3 = w4 = g0 = g1 = g2 = 0.0
    nx, ny = np.cos(alpha), np.sin(alpha)
    for k in members:
        c = cosines[k] * nx + sines[k] * ny
        t = (rho * (sines[k] * nx - cosines[k] * ny) / c - middle) / half
        error = ranges[k] * c - rho
        weight = 1.0 / (c * sigmas[k]) ** 2
        w0, g0 = w0 + weight, g0 + weight * error
        w1, g1 = w1 + weight * t, g1 + weight * t * error
        w2, g2 = w2 + weight * t * t, g2 + weight * t * t * error
        w3, w4 = w3 + weight * t**3, w4 + weight * t**4
    _, _, sagitta, det = solve_symmetric(w0, w1, w2, w2, w3, w4, g0, g1, g2)
    return 4.0 * sagitta / half, 4.0 * np.sqrt((w0 * w2 - w1 * w1) / det) / half
