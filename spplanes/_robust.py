"""A plane fit that gross outliers cannot pull: a deterministic consensus start, then Tukey's biweight.

The scale of the residuals is known, as every point brings its covariance; nothing is estimated from the spread.

References:
    Beaton, Tukey, "The fitting of power series", Technometrics 16, 1974 (the biweight).
    Torr, Zisserman, "MLESAC", CVIU 78, 2000 (scoring hypotheses by a truncated cost).
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from spplanes._fit_kernels import descend, finish
from spplanes._fit_sums import FLOOR
from spplanes._rows import COLLINEAR, OK, TOO_FEW, write_frame

#: Tukey's constant: 95 % efficient on clean Gaussian points, and blind to what is farther than this many sigma.
CUTOFF = 4.685
#: Triples tried: with 30 % outliers, all of them hold one with a chance of 1e-18.
TRIALS = 100
#: Points that judge a triple, at most, evenly spread over the group.
JUDGES = 500
#: Where the triples come from: fractions of the group, the same in every run.
FRACTIONS = np.random.default_rng(0).random((TRIALS, 3))


def _biweight_moments(cutoff: float) -> tuple[float, float, float]:
    """Means over a standard normal u of the weight (1 - q)^2, of psi' and of psi^2; q = u^2 / cutoff^2 <= 1."""
    u = np.linspace(-cutoff, cutoff, 20001)
    density = np.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi)
    q = (u / cutoff) ** 2
    means = [np.trapezoid(f * density, u) for f in ((1 - q) ** 2, (1 - q) * (1 - 5 * q), u**2 * (1 - q) ** 4)]
    return float(means[0]), float(means[1]), float(means[2])


_WEIGHT, _SLOPE, _SCORE = _biweight_moments(CUTOFF)
#: By how much a step with the weights' information falls short of the cost's expected curvature.
GAIN = _WEIGHT / _SLOPE
#: Variance over that which the weights' information promises; the kept inliers are in that information by _WEIGHT.
VARIANCE_FACTOR = _SCORE / _SLOPE**2 * _WEIGHT


@njit(cache=True)
def triple_frame(points, i, j, k, frame) -> bool:
    """Write the frame of the plane through three points; False where they are as good as collinear, or not three."""
    a, b = points[j] - points[i], points[k] - points[i]
    normal = np.empty(3)
    normal[0] = a[1] * b[2] - a[2] * b[1]
    normal[1] = a[2] * b[0] - a[0] * b[2]
    normal[2] = a[0] * b[1] - a[1] * b[0]
    area, length2 = math.sqrt(np.sum(normal * normal)), np.sum(a * a)
    if not area > 1e-6 * max(length2, np.sum(b * b)):
        return False
    write_frame(normal / area, a / math.sqrt(length2), points[i], frame)
    return True


@njit(cache=True)
def truncated_cost(points, covs, step, order, lo, hi, stride, frame, cutoff2) -> float:
    """Sum of min(z^2 / s^2, cutoff2) over every ``stride``-th point of a group."""
    nx, ny, nz = frame[0, 2], frame[1, 2], frame[2, 2]
    cost = 0.0
    for k in range(lo, hi, stride):
        i = order[k]
        c = covs[i * step]
        z = nx * (points[i, 0] - frame[0, 3]) + ny * (points[i, 1] - frame[1, 3]) + nz * (points[i, 2] - frame[2, 3])
        variance = nx * nx * c[0, 0] + ny * ny * c[1, 1] + nz * nz * c[2, 2]
        variance += 2.0 * (nx * ny * c[0, 1] + nx * nz * c[0, 2] + ny * nz * c[1, 2])
        cost += min(z * z / max(variance, FLOOR * (c[0, 0] + c[1, 1] + c[2, 2])), cutoff2)
    return cost


@njit(cache=True)
def consensus_frame(points, covs, step, order, lo, hi, fractions, cutoff2, frame) -> int:
    """Write the frame of the triple whose plane the group agrees with most."""
    n = hi - lo
    stride = max(1, n // JUDGES)
    trial, best = np.empty((4, 4)), np.inf
    for t in range(fractions.shape[0]):
        i = order[lo + int(fractions[t, 0] * n)]
        j = order[lo + int(fractions[t, 1] * n)]
        k = order[lo + int(fractions[t, 2] * n)]
        if not triple_frame(points, i, j, k, trial):
            continue
        cost = truncated_cost(points, covs, step, order, lo, hi, stride, trial, cutoff2)
        if cost < best:
            best = cost
            frame[:] = trial
    return OK if best < np.inf else COLLINEAR


@njit(cache=True)
def robust_group(points, covs, step, order, lo, hi, viewpoint, fractions, frame, covariance, sums) -> int:
    """Tukey fit of one group; writes frame, covariance and the sums of the kept points at the minimum."""
    if hi - lo < 3:
        return TOO_FEW
    base = np.empty((4, 4))
    status = consensus_frame(points, covs, step, order, lo, hi, fractions, 4.0 * CUTOFF * CUTOFF, base)
    for widening in (2.0, 1.0):
        if status == OK:
            cutoff = widening * CUTOFF
            status = descend(points, covs, step, order, lo, hi, cutoff * cutoff, GAIN, base, sums)
    if status != OK:
        return status
    return finish(base, sums, viewpoint, VARIANCE_FACTOR, frame, covariance)
