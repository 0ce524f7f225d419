"""Kernels of line extraction: order the beams, find breaks, split and merge.

Along a straight line the inverse range is linear in (cos a, sin a) of the bearing a: 1/r = u cos a + v sin a with
(u, v) = (cos alpha, sin alpha) / rho. Range noise sigma becomes sigma / r^2 of the inverse range, so the weighted
least-squares fit of any set of beams follows from six sums (the columns of `beam_moments`), and sums add: a fit, its
chi2 and the chi2 of a merge are O(1). The fit is first order in sigma / r; `spplanes.lines._fit` refines it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner


class Beams(NamedTuple):
    """Returns in order of bearing, (V,) each: rad, and m with their standard deviations."""

    bearings: np.ndarray
    cosines: np.ndarray
    sines: np.ndarray
    ranges: np.ndarray
    sigmas: np.ndarray


N_SUMS = 6


@inlined
def full_turn(angle):
    """The same angle in [0, 2 pi); of most it is seen without a division."""
    return angle if 0.0 <= angle < 2.0 * np.pi else angle % (2.0 * np.pi)


def order_beams(
    ranges: FloatArray, angles: FloatArray, range_min: float, range_max: float
) -> tuple[np.ndarray, float, float]:
    """Indices of the returns in order of bearing, from the widest gap on (V,); that gap and the median step, rad."""
    turn = (angles - angles[0]) % (2.0 * np.pi)
    order = np.argsort(turn, kind="stable")
    steps = np.diff(turn[order], append=turn[order[0]] + 2.0 * np.pi)
    widest = int(np.argmax(steps))
    order = np.roll(order, -widest - 1)
    seen = ranges[order]
    return order[(range_min < seen) & (seen < range_max)], float(steps[widest]), float(np.median(steps))


@inlined
def slope_sigmas(beams, bearing_sigma, result):
    """Range noise with the bearing noise in it, (V,): times the slope dr/da, at a jump that of the flatter side."""
    bearings, ranges, n = beams.bearings, beams.ranges, beams.bearings.size
    for k in range(n):
        slope = 0.0
        if bearing_sigma > 0.0:
            slope = min(slope_at(bearings, ranges, k), slope_at(bearings, ranges, (k + 1) % n))
        result[k] = np.hypot(beams.sigmas[k], bearing_sigma * slope)


@inlined
def slope_at(bearings, ranges, k):
    """Slope dr/da from the beam before to beam k."""
    return abs(ranges[k] - ranges[k - 1]) / max(full_turn(bearings[k] - bearings[k - 1]), 1e-9)


@inner(cache=True)
def beam_moments(beams):
    """Share of every beam in the six sums (V, 6): w cc, w cs, w ss, w cq, w sq, w qq; q = 1/r, w = r^4 / sigma^2."""
    moments = np.empty((beams.ranges.size, N_SUMS))
    for k in range(beams.ranges.size):
        c, s, r = beams.cosines[k], beams.sines[k], beams.ranges[k]
        scale = (r / beams.sigmas[k]) ** 2
        moments[k, 0] = scale * r * r * c * c
        moments[k, 1] = scale * r * r * c * s
        moments[k, 2] = scale * r * r * s * s
        moments[k, 3] = scale * r * c
        moments[k, 4] = scale * r * s
        moments[k, 5] = scale
    return moments


@inner(cache=True)
def fit_of(cc, cs, ss, cq, sq, qq):
    """(u, v, chi2) of the best line through beams with these six sums; one bearing only: the best perpendicular."""
    det = cc * ss - cs * cs
    if det <= 1e-13 * (cc + ss) ** 2:
        weight = cc + ss
        return cq / weight, sq / weight, max(0.0, qq - (cq * cq + sq * sq) / weight)
    u = (ss * cq - cs * sq) / det
    v = (cc * sq - cs * cq) / det
    return u, v, max(0.0, qq - u * cq - v * sq)


@inlined
def fit_sums(m):
    """`fit_of` the six sums in an array."""
    return fit_of(m[0], m[1], m[2], m[3], m[4], m[5])


@inner(cache=True)
def sum_of(moments, members):
    """The six sums of some beams, an array or a range of them."""
    total = np.zeros(N_SUMS)
    for k in members:
        for i in range(N_SUMS):
            total[i] += moments[k, i]
    return total


@inlined
def triple_fails(beams, sines, j, gate):
    """True when a beam and those beside it are not on one line: chi2 with 1 dof of their collinearity above `gate`.
    `sines` are those of the steps to each beam from the one before."""
    bearings, ranges, sigmas = beams.bearings, beams.ranges, beams.sigmas
    i, k = j - 1, j + 1 if j + 1 < bearings.size else 0
    left, right = sines[k], sines[j]
    middle = -np.sin(bearings[k] - bearings[i])
    error = left / ranges[i] + middle / ranges[j] + right / ranges[k]
    variance = (
        (left * sigmas[i] / ranges[i] ** 2) ** 2
        + (middle * sigmas[j] / ranges[j] ** 2) ** 2
        + (right * sigmas[k] / ranges[k] ** 2) ** 2
    )
    return error * error > gate * variance


@inlined
def find_breaks(beams, max_step, gate):
    """For each beam the kind of break before it (V,): 0 none, 1 the depth jumps, 2 beams are missing; closed ring."""
    bearings, n = beams.bearings, beams.bearings.size
    sines = np.empty(n)
    for k in range(n):
        sines[k] = np.sin(bearings[k] - bearings[k - 1])
    fails = np.empty(n, dtype=np.bool_)
    for k in range(n):
        fails[k] = triple_fails(beams, sines, k, gate)
    breaks = np.zeros(n, dtype=np.int8)
    for k in range(n):
        if full_turn(bearings[k] - bearings[k - 1]) > max_step:
            breaks[k] = 2
        elif fails[k] and fails[k - 1]:
            breaks[k] = 1
    return breaks


@inner(cache=True)
def best_split(moments, low, high, cost):
    """Where two lines explain low..high-1 best: (first beam of the second line, chi2 gained over one line). Into
    `cost`, scratch of `high` floats, goes chi2 and what each parameter used must earn of it: without that two beams,
    which some line always fits, would leave the longer piece for nothing."""
    parameter = 4.0  # the 95 % quantile of chi2 with 1 dof, rounded up
    cc = cs = ss = cq = sq = qq = before = 0.0  # scalars: an array of six sums would be written back at every beam
    for k in range(low, high):
        cost[k] = before + parameter * min(2, k - low)
        cc, cs, ss = cc + moments[k, 0], cs + moments[k, 1], ss + moments[k, 2]
        cq, sq, qq = cq + moments[k, 3], sq + moments[k, 4], qq + moments[k, 5]
        before = fit_of(cc, cs, ss, cq, sq, qq)[2]
    cc = cs = ss = cq = sq = qq = 0.0
    at, best = low, np.inf
    for k in range(high - 1, low, -1):
        cc, cs, ss = cc + moments[k, 0], cs + moments[k, 1], ss + moments[k, 2]
        cq, sq, qq = cq + moments[k, 3], sq + moments[k, 4], qq + moments[k, 5]
        cost[k] += fit_of(cc, cs, ss, cq, sq, qq)[2] + parameter * min(2, high - k)
        if cost[k] < best:
            best, at = cost[k], k
    return at, before + 4.0 * parameter - best


@inlined
def split_gate(n, significance):
    """Quantile of chi2 with 2 dof for the best of n places to split (Bonferroni)."""
    return -2.0 * np.log(significance / n)


@inner(cache=True)
def split(moments, breaks, significance):
    """Cut the sequence into pieces that no further cut improves significantly: the first beam of each, (M + 1,)."""
    n = moments.shape[0]
    is_start = np.zeros(n + 1, dtype=np.bool_)
    is_start[0] = is_start[n] = True
    left = np.empty(n)
    stack = np.empty((n + 1, 2), dtype=np.int64)
    low, depth = 0, 0
    for k in range(1, n + 1):
        if k == n or breaks[k] > 0:
            is_start[low] = True
            stack[0, 0], stack[0, 1], depth = low, k, 1
            while depth > 0:
                depth -= 1
                a, b = stack[depth, 0], stack[depth, 1]
                if b - a < 3:
                    continue
                at, gain = best_split(moments, a, b, left)
                if gain > split_gate(b - a, significance):
                    is_start[at] = True
                    stack[depth, 0], stack[depth, 1] = a, at
                    stack[depth + 1, 0], stack[depth + 1, 1] = at, b
                    depth += 2
            low = k
    return np.flatnonzero(is_start)


@inner(cache=True)
def refine(moments, breaks, starts, significance):
    """Move the boundary of neighbouring pieces to where it is best; drop it when it gains too little."""
    cost = np.empty(moments.shape[0])
    kept = starts.copy()
    count = 1
    for i in range(1, starts.size - 1):
        low, high = kept[count - 1], starts[i + 1]
        at, gain = starts[i], np.inf
        if breaks[starts[i]] < 2 and high - low >= 3:
            at, gain = best_split(moments, low, high, cost)
        if gain > split_gate(high - low, significance):
            kept[count] = at
            count += 1
    kept[count] = starts[-1]
    return kept[: count + 1]
