"""The kernel behind `spplanes.extract_lines`: from ordered returns to lines and the beams that support them."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes._line_fit import fit_beams, grow, trim, turning
from spplanes._line_kernels import beam_moments, find_breaks, fit_sums, merge, order_beams, refine, split
from spplanes._line_round import find_round

#: Columns of a result row: alpha, rho, var alpha, cov, var rho, chi2, first bearing, last bearing.
N_RESULT = 8
#: 99 % quantiles of chi2 with 1, 2, 3 dof: what that many end beams may add to the chi2 of the others.
END_GATES = np.array((7.88, 10.6, 12.84))


@njit(cache=True, error_model="numpy")
def label_beams(bearings, ranges, sigmas, breaks, max_missing, significance, max_turning):
    """Split, take out what is round, merge: label (V,) and whether it is undecided (V,) of each return, number of labels."""
    moments = beam_moments(bearings, ranges, sigmas)
    starts, undecided = refine(moments, breaks, split(moments, breaks, significance), significance)
    is_round = find_round(bearings, ranges, sigmas, moments, breaks, starts, significance, 0.5 * max_turning)
    gate = -2.0 * np.log(significance)
    labels, n_labels = merge(bearings, ranges, sigmas, moments, starts, is_round, max_missing, gate)
    return labels, undecided, n_labels


@njit(cache=True, error_model="numpy")
def ring_start(labels, count):
    """First beam of a line that no other line bridges, where a closed ring can be cut without cutting a line; else 0."""
    first = np.full(count, labels.size)
    last = np.full(count, -1)
    for k in range(labels.size):
        if labels[k] >= 0:
            first[labels[k]] = min(first[labels[k]], k)
            last[labels[k]] = k
    for i in range(1, count):
        bridged = False
        for j in range(count):
            bridged |= j != i and first[j] < first[i] <= last[j]
        if not bridged:
            return first[i]
    return 0


@njit(cache=True, error_model="numpy")
def fit_label(bearings, ranges, sigmas, breaks, labels, undecided, label, gate):
    """Maximum-likelihood line of the decided beams of one label and all beams on it, its ends trimmed and grown."""
    members = np.nonzero(labels == label)[0]
    core = members[~undecided[members]]
    core = drop_doubtful_ends(beam_moments(bearings[core], ranges[core], sigmas[core]), core)
    line = start_line(bearings, ranges, sigmas, core)
    for _ in range(2):
        if core.size < 3:
            break
        line = fit_beams(bearings, ranges, sigmas, core, line[0], line[1])
        if not np.isfinite(line[5]):
            break
        labels[members] = -1
        members = trim(bearings, ranges, sigmas, members, line, gate)
        n_before = core.size
        core = core[(core >= members[0]) & (core <= members[-1])]
        members = grow(bearings, ranges, sigmas, breaks, labels, members, line, gate)
        labels[members] = label
        if core.size == n_before:
            break
    return line, members, core.size


@njit(cache=True, error_model="numpy")
def drop_doubtful_ends(moments, members):
    """Members without the few beams at each end that the others contradict: those of a surface just beyond."""
    low, high = 0, members.size
    total = moments.sum(axis=0)
    whole = fit_sums(total)[2]
    for side in range(2):
        m = 0
        rest = total.copy()
        while m < END_GATES.size and high - low - m > 4:
            rest -= moments[low + m] if side == 0 else moments[high - 1 - m]
            m += 1
            chi2 = fit_sums(rest)[2]
            if whole - chi2 > END_GATES[m - 1]:
                low, high = (low + m, high) if side == 0 else (low, high - m)
                total, whole, m = rest.copy(), chi2, 0
    return members[low:high]


@njit(cache=True, error_model="numpy")
def start_line(bearings, ranges, sigmas, members):
    """The line of the inverse-range fit, as `fit_beams` returns it."""
    total = np.zeros(6)
    for row in beam_moments(bearings[members], ranges[members], sigmas[members]):
        total += row
    u, v, chi2 = fit_sums(total)
    return np.arctan2(v, u), 1.0 / np.hypot(u, v), 0.0, 0.0, 0.0, chi2


@njit(cache=True, error_model="numpy")
def is_line(bearings, ranges, sigmas, members, n, line, min_points, max_turning, max_curvature, max_misfit):
    """True when n fitted beams are enough, fit, are no arc that turns by `max_turning`, and (alpha, rho) is Gaussian."""
    if n < max(min_points, 3) or not np.isfinite(line[5]) or line[5] > max_misfit * (n - 2):
        return False
    _, rho, v_alpha, cov, v_rho, _ = line
    if 0.5 * rho * v_alpha > max_curvature * np.sqrt(v_rho - cov * cov / v_alpha):
        return False
    arc, arc_sigma = turning(bearings, ranges, sigmas, members, line)
    return abs(arc) + 3.0 * arc_sigma < max_turning


@njit(cache=True, error_model="numpy")
def extract(
    ranges,
    angles,
    sigmas,
    range_min,
    range_max,
    max_missing,
    significance,
    min_points,
    max_turning,
    max_curvature,
    max_misfit,
):
    """Lines of one scan: rows (M, 8) as N_RESULT says, the supporting beams one line after the other, and their counts."""
    beams, widest, step = order_beams(ranges, angles, range_min, range_max)
    rows = np.empty((beams.size, N_RESULT))
    support = np.empty(beams.size, dtype=np.int64)
    counts = np.zeros(beams.size, dtype=np.int64)
    n_lines = n_support = 0
    if beams.size < 3:
        return rows[:0], support[:0], counts[:0]
    gate = -2.0 * np.log(significance)
    max_step = (max_missing + 1.5) * step
    for attempt in range(2):
        a, r, s = angles[beams], ranges[beams], sigmas[beams]
        breaks = find_breaks(a, r, s, max_step, gate)
        labels, undecided, n_labels = label_beams(a, r, s, breaks, max_missing, significance, max_turning)
        if attempt == 1 or widest > max_step:
            break
        cut = ring_start(labels, n_labels)
        if cut == 0:
            break
        beams = np.concatenate((beams[cut:], beams[:cut]))
    for label in range(n_labels):
        line, members, n_core = fit_label(a, r, s, breaks, labels, undecided, label, gate)
        if is_line(a, r, s, members, n_core, line, min_points, max_turning, max_curvature, max_misfit):
            rows[n_lines, :6] = np.array(line)
            rows[n_lines, 6], rows[n_lines, 7] = a[members[0]], a[members[-1]]
            support[n_support : n_support + members.size] = beams[members]
            counts[n_lines] = members.size
            n_support += members.size
            n_lines += 1
    return rows[:n_lines], support[:n_support], counts[:n_lines]
