"""Kernels of line extraction: the beams a line rests on, their likeliest line, its ends, how straight it is."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner
from spplanes.lines._kernels import N_SUMS, fit_sums, sum_of
from spplanes.lines._round import solve_symmetric


@inlined
def drop_borders(breaks, labels, members):
    """Members without those beside a return that is not on the line; all of them when fewer than three would be left.
    Such a beam may be on what joins the two surfaces: of a door jamb within its noise of the wall no residual tells,
    yet it turns the line."""
    kept, count = np.empty(members.size, dtype=np.int64), 0
    for k in members:
        after = (k + 1) % labels.size
        begins = breaks[k] < 2 and labels[k - 1] != labels[k]
        ends = breaks[after] < 2 and labels[after] != labels[k]
        if not (begins or ends):
            kept[count] = k
            count += 1
    return kept[:count] if count >= 3 else members


@inner(cache=True)
def drop_doubtful_ends(moments, members):
    """Members without the few beams at each end that the others contradict: those of a surface just beyond."""
    gates = 7.88, 10.6, 12.84  # quantiles of chi2: what 1, 2, 3 end beams may add to the chi2 of the others
    low, high = 0, members.size
    total = sum_of(moments, members)
    whole = fit_sums(total)[2]
    for side in range(2):
        m = 0
        rest = total.copy()
        while m < len(gates) and high - low - m > 4:
            beam = members[low + m] if side == 0 else members[high - 1 - m]
            for i in range(N_SUMS):
                rest[i] -= moments[beam, i]
            m += 1
            chi2 = fit_sums(rest)[2]
            if whole - chi2 > gates[m - 1]:
                low, high = (low + m, high) if side == 0 else (low, high - m)
                total, whole, m = rest.copy(), chi2, 0
    return members[low:high]


@inlined
def normal_equations(beams, members, alpha, rho):
    """Of the range residuals e: information sum J J^T / sigma^2 (3 entries), gradient sum J e / sigma^2 (2), chi2. J is
    the derivative of the range rho / cos(a - alpha) by (alpha, rho): (-rho sin / cos^2, 1 / cos). Cosines and sines are
    those of the bearings; those of a - alpha follow without another call for every beam."""
    cosines, sines, ranges, sigmas = beams.cosines, beams.sines, beams.ranges, beams.sigmas
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
def fit_beams(beams, members, alpha, rho):
    """Gauss-Newton from (alpha, rho): (alpha, rho, var alpha, cov, var rho, chi2); chi2 = inf: it did not converge."""
    for _ in range(20):
        i00, i01, i11, g0, g1, chi2 = normal_equations(beams, members, alpha, rho)
        det = i00 * i11 - i01 * i01
        if not det > 1e-13 * i00 * i11:
            break
        d0, d1 = (i11 * g0 - i01 * g1) / det, (i00 * g1 - i01 * g0) / det
        alpha, rho = alpha + d0, rho + d1
        if not rho > 0.0:
            break
        if d0 * g0 + d1 * g1 < 1e-6:  # what is left of chi2 is a thousandth of a standard deviation
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
def belongs(beams, k, line, gate):
    """True when beam k, next to the line, is on it: chi2 under `gate`, where the line predicts its range well, with at
    most five times the variance of a beam."""
    alpha, rho, v00, v01, v11, _ = line
    bearing, r, sigma = beams.bearings[k], beams.ranges[k], beams.sigmas[k]
    c, s = np.cos(bearing - alpha), np.sin(bearing - alpha)
    if c <= 0.0:
        return False
    by_alpha, by_rho = -rho * s / (c * c), 1.0 / c
    variance = sigma * sigma + by_alpha * by_alpha * v00 + 2.0 * by_alpha * by_rho * v01 + by_rho * by_rho * v11
    return variance < 5.0 * sigma * sigma and (r - rho / c) ** 2 < gate * variance


@inner(cache=True)
def trim(beams, members, line, gate):
    """Members without the end beams that do not belong to the line."""
    low, high = 0, members.size
    while high - low > 2 and misses(beams, members[low], line, gate):
        low += 1
    while high - low > 2 and misses(beams, members[high - 1], line, gate):
        high -= 1
    return members[low:high]


@inlined
def misses(beams, k, line, gate):
    """True when beam k, already on the line, is farther from it than its noise allows."""
    return (beams.ranges[k] - line[1] / np.cos(beams.bearings[k] - line[0])) ** 2 > gate * beams.sigmas[k] ** 2


@inner(cache=True)
def grow(beams, breaks, labels, members, line, gate):
    """Members with the free beams next to both ends that belong to the line."""
    low, high = members[0], members[-1] + 1
    while low > 0 and breaks[low] < 2 and labels[low - 1] < 0:
        if not belongs(beams, low - 1, line, gate):
            break
        low -= 1
    while high < labels.size and breaks[high] < 2 and labels[high] < 0:
        if not belongs(beams, high, line, gate):
            break
        high += 1
    return np.concatenate((np.arange(low, members[0]), members, np.arange(members[-1] + 1, high)))


@inlined
def turning(beams, members, line):
    """Angle, rad, by which the beams turn from end to end if they are an arc, and its standard deviation. The second-
    order coefficient of the normal residual over 1, t, t^2 with t in [-1, 1] is the sagitta."""
    alpha, rho = line[0], line[1]
    bearings, cosines, sines = beams.bearings, beams.cosines, beams.sines
    first, last = rho * np.tan(bearings[members[0]] - alpha), rho * np.tan(bearings[members[-1]] - alpha)
    half, middle = 0.5 * (last - first), 0.5 * (last + first)
    w0 = w1 = w2 = w3 = w4 = g0 = g1 = g2 = 0.0
    nx, ny = np.cos(alpha), np.sin(alpha)
    for k in members:
        c = cosines[k] * nx + sines[k] * ny
        t = (rho * (sines[k] * nx - cosines[k] * ny) / c - middle) / half
        error = beams.ranges[k] * c - rho
        weight = 1.0 / (c * beams.sigmas[k]) ** 2
        w0, g0 = w0 + weight, g0 + weight * error
        w1, g1 = w1 + weight * t, g1 + weight * t * error
        w2, g2 = w2 + weight * t * t, g2 + weight * t * t * error
        w3, w4 = w3 + weight * t**3, w4 + weight * t**4
    _, _, sagitta, det = solve_symmetric((w0, w1, w2, w2, w3, w4), g0, g1, g2)
    return 4.0 * sagitta / half, 4.0 * np.sqrt((w0 * w2 - w1 * w1) / det) / half
