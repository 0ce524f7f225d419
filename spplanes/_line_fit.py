"""Kernels of line extraction: the maximum-likelihood line of a set of beams, its ends, and the test that it is straight."""

from __future__ import annotations

import numpy as np
from numba import njit

#: Gauss-Newton stops when a step is below this share of a standard deviation; it takes two or three steps.
STEP_TOLERANCE = 1e-6
MAX_STEPS = 20
#: A line grows only where it predicts the range with at most this many times the variance of a beam.
MAX_PREDICTION = 5.0


@njit(cache=True, error_model="numpy")
def information(bearings, sigmas, members, alpha, rho):
    """Fisher information of (alpha, rho) as its three entries: sum J J^T / sigma^2, J of the range rho / cos(a - alpha)."""
    i00 = i01 = i11 = 0.0
    for k in members:
        c, s = np.cos(bearings[k] - alpha), np.sin(bearings[k] - alpha)
        by_alpha, by_rho = -rho * s / (c * c * sigmas[k]), 1.0 / (c * sigmas[k])
        i00 += by_alpha * by_alpha
        i01 += by_alpha * by_rho
        i11 += by_rho * by_rho
    return i00, i01, i11


@njit(cache=True, error_model="numpy")
def descend(bearings, ranges, sigmas, members, alpha, rho):
    """Gradient sum J e / sigma^2 of the range residuals e at (alpha, rho), and their chi2."""
    g0 = g1 = chi2 = 0.0
    for k in members:
        c, s = np.cos(bearings[k] - alpha), np.sin(bearings[k] - alpha)
        error = (ranges[k] - rho / c) / sigmas[k]
        g0 -= error * rho * s / (c * c * sigmas[k])
        g1 += error / (c * sigmas[k])
        chi2 += error * error
    return g0, g1, chi2


@njit(cache=True, error_model="numpy")
def fit_beams(bearings, ranges, sigmas, members, alpha, rho):
    """Gauss-Newton from (alpha, rho): (alpha, rho, var alpha, cov, var rho, chi2); chi2 is inf when it does not converge."""
    for _ in range(MAX_STEPS):
        g0, g1, chi2 = descend(bearings, ranges, sigmas, members, alpha, rho)
        i00, i01, i11 = information(bearings, sigmas, members, alpha, rho)
        det = i00 * i11 - i01 * i01
        if not det > 1e-13 * i00 * i11:
            break
        d0, d1 = (i11 * g0 - i01 * g1) / det, (i00 * g1 - i01 * g0) / det
        alpha, rho = alpha + d0, rho + d1
        if d0 * d0 * i00 + d1 * d1 * i11 < STEP_TOLERANCE**2 * members.size:
            return alpha, rho, i11 / det, -i01 / det, i00 / det, chi2
        if not rho > 0.0:
            break
    return alpha, rho, 0.0, 0.0, 0.0, np.inf


@njit(cache=True, error_model="numpy")
def belongs(bearing, r, sigma, line, gate):
    """True when a beam next to the line is on it: chi2 with 1 dof under `gate`, where the line predicts its range well."""
    alpha, rho, v00, v01, v11, _ = line
    c, s = np.cos(bearing - alpha), np.sin(bearing - alpha)
    if c <= 0.0:
        return False
    by_alpha, by_rho = -rho * s / (c * c), 1.0 / c
    variance = sigma * sigma + by_alpha * by_alpha * v00 + 2.0 * by_alpha * by_rho * v01 + by_rho * by_rho * v11
    return variance < MAX_PREDICTION * sigma * sigma and (r - rho / c) ** 2 < gate * variance


@njit(cache=True, error_model="numpy")
def trim(bearings, ranges, sigmas, members, line, gate):
    """Members without the end beams that do not belong to the line."""
    low, high = 0, members.size
    while high - low > 2 and misses(bearings, ranges, sigmas, members[low], line, gate):
        low += 1
    while high - low > 2 and misses(bearings, ranges, sigmas, members[high - 1], line, gate):
        high -= 1
    return members[low:high]


@njit(cache=True, error_model="numpy")
def misses(bearings, ranges, sigmas, k, line, gate):
    """True when beam k, already on the line, is farther from it than its noise allows."""
    return (ranges[k] - line[1] / np.cos(bearings[k] - line[0])) ** 2 > gate * sigmas[k] ** 2


@njit(cache=True, error_model="numpy")
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
    return np.concatenate((np.arange(low, members[0]), members, np.arange(members[-1] + 1, high)))


@njit(cache=True, error_model="numpy")
def turning(bearings, ranges, sigmas, members, line):
    """How much the beams turn from end to end if they are an arc, rad, and its standard deviation: the fit of 1, t, t^2."""
    alpha, rho = line[0], line[1]
    first, last = rho * np.tan(bearings[members[0]] - alpha), rho * np.tan(bearings[members[-1]] - alpha)
    half, middle = 0.5 * (last - first), 0.5 * (last + first)
    normal, right = np.zeros((3, 3)), np.zeros(3)
    row = np.ones(3)
    for k in members:
        c = np.cos(bearings[k] - alpha)
        row[1] = (rho * np.tan(bearings[k] - alpha) - middle) / half
        row[2] = row[1] * row[1]
        weight = 1.0 / (c * sigmas[k]) ** 2
        for i in range(3):
            right[i] += weight * row[i] * (ranges[k] * c - rho)
            for j in range(3):
                normal[i, j] += weight * row[i] * row[j]
    covariance = np.linalg.inv(normal)
    sagitta = covariance[2, 0] * right[0] + covariance[2, 1] * right[1] + covariance[2, 2] * right[2]
    return 4.0 * sagitta / half, 4.0 * np.sqrt(covariance[2, 2]) / half
