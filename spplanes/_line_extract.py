"""The kernel behind `spplanes.extract_lines`: from ordered returns to lines and the beams that support them."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes._line_fit import fit_beams, grow, line_sigmas, trim, turning
from spplanes._line_kernels import beam_moments, find_breaks, fit_sums, order_beams, refine, slope_sigmas, split
from spplanes._line_merge import add_flatness, merge
from spplanes._line_round import find_round

#: Columns of a result row: alpha, rho, chi2, dof, covariance (4), end points (4).
N_RESULT = 12
#: 99 % quantiles of chi2 with 1, 2, 3 dof: what that many end beams may add to the chi2 of the others.
END_GATES = np.array((7.88, 10.6, 12.84))


@njit(cache=True, error_model="numpy")
def label_beams(bearings, ranges, sigmas, breaks, max_missing, max_step, flatness, significance, max_turning):
    """Split, take out what is round, merge: label of each return (V,), whether it is undecided (V,), label count."""
    moments = beam_moments(bearings, ranges, sigmas)
    starts, undecided = refine(moments, breaks, split(moments, breaks, significance), significance)
    is_round = find_round(bearings, ranges, sigmas, moments, breaks, starts, significance, 0.5 * max_turning)
    gate = -2.0 * np.log(significance)
    labels, n_labels = merge(bearings, ranges, sigmas, moments, starts, is_round, max_missing, max_step, flatness, gate)
    return labels, undecided, n_labels


@njit(cache=True, error_model="numpy")
def ring_start(labels, count):
    """Where a closed ring can be cut without cutting a line: the first beam of one that no other bridges; else 0."""
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
def fit_label(bearings, ranges, sigmas, bearing_sigma, breaks, labels, undecided, label, gate):
    """Line of one label; the beams on it, ends trimmed and grown; how many were decided, and how many of them fitted.

    Decided beams beside another surface are on the line but not in the fit.
    """
    members = np.nonzero(labels == label)[0]
    core = members[~undecided[members]]
    core = drop_doubtful_ends(beam_moments(bearings[core], ranges[core], sigmas[core]), core)
    n_borders = core.size
    core = drop_borders(breaks, labels, core)
    n_borders -= core.size
    line = start_line(bearings, ranges, sigmas, core)
    if bearing_sigma > 0.0:
        sigmas = line_sigmas(bearings, sigmas, np.arange(bearings.size), line[0], line[1], bearing_sigma)
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
    return line, members, core.size + n_borders, core.size


@njit(cache=True, error_model="numpy")
def drop_borders(breaks, labels, members):
    """Members without those beside a return that is not on the line; all of them when fewer than three would be left.

    Such a beam may already be on what joins the two surfaces. Of a door jamb hit by one beam within its noise of the
    wall no residual tells, yet at the end of the line it turns it.
    """
    inner = np.empty(members.size, dtype=np.bool_)
    for i, k in enumerate(members):
        after = (k + 1) % labels.size
        begins = breaks[k] < 2 and labels[k - 1] != labels[k]
        ends = breaks[after] < 2 and labels[after] != labels[k]
        inner[i] = not (begins or ends)
    return members[inner] if inner.sum() >= 3 else members


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
def is_line(
    bearings, ranges, sigmas, members, n_decided, n_fitted, line, min_points, max_turning, max_curvature, max_misfit
):
    """True when the beams suffice, fit, are no arc that turns by `max_turning`, and (alpha, rho) is Gaussian."""
    if n_decided < max(min_points, 3) or not np.isfinite(line[5]) or line[5] > max_misfit * (n_fitted - 2):
        return False
    _, rho, v_alpha, cov, v_rho, _ = line
    if 0.5 * rho * v_alpha > max_curvature * np.sqrt(v_rho - cov * cov / v_alpha):
        return False
    arc, arc_sigma = turning(bearings, ranges, sigmas, members, line)
    return abs(arc) + 3.0 * arc_sigma < max_turning


@njit(cache=True, error_model="numpy")
def label_scan(
    ranges, angles, sigmas, bearing_sigma, flatness, range_min, range_max, max_missing, significance, max_turning
):
    """Order and label the returns: beams (V,), breaks (V,), labels (V,), undecided (V,), number of labels."""
    beams, widest, step = order_beams(ranges, angles, range_min, range_max)
    max_step = (max_missing + 1.5) * step
    n_cuts = 0
    while True:
        a, r = angles[beams], ranges[beams]
        s = slope_sigmas(a, r, sigmas[beams], bearing_sigma)
        breaks = find_breaks(a, r, s, max_step, -2.0 * np.log(significance))
        labels, undecided, n_labels = label_beams(
            a, r, s, breaks, max_missing, max_step, flatness, significance, max_turning
        )
        cut = ring_start(labels, n_labels)
        if n_cuts == 1 or widest > max_step or cut == 0:
            return beams, breaks, labels, undecided, n_labels
        beams = np.concatenate((beams[cut:], beams[:cut]))
        n_cuts += 1


@njit(cache=True, error_model="numpy")
def extract(
    ranges,
    angles,
    sigmas,
    bearing_sigma,
    flatness,
    range_min,
    range_max,
    max_missing,
    significance,
    min_points,
    max_turning,
    max_curvature,
    max_misfit,
):
    """Lines of one scan: rows (M, 12) as N_RESULT says, the beams on them one line after the other, their counts."""
    beams, breaks, labels, undecided, n_labels = label_scan(
        ranges, angles, sigmas, bearing_sigma, flatness, range_min, range_max, max_missing, significance, max_turning
    )
    a, r, s = angles[beams], ranges[beams], sigmas[beams]
    rows = np.empty((n_labels, N_RESULT))
    support = np.empty(beams.size, dtype=np.int64)
    counts = np.zeros(n_labels, dtype=np.int64)
    n_lines = n_support = 0
    for label in range(n_labels):
        line, members, n_decided, n_fitted = fit_label(
            a, r, s, bearing_sigma, breaks, labels, undecided, label, -2.0 * np.log(significance)
        )
        if is_line(a, r, s, members, n_decided, n_fitted, line, min_points, max_turning, max_curvature, max_misfit):
            write_row(rows[n_lines], line, n_fitted - 2, a[members[0]], a[members[-1]], flatness)
            support[n_support : n_support + members.size] = beams[members]
            counts[n_lines] = members.size
            n_support += members.size
            n_lines += 1
    return rows[:n_lines], support[:n_support], counts[:n_lines]


@njit(cache=True, error_model="numpy")
def write_row(row, line, dof, first, last, flatness):
    """Fill a result row; the end points are where the first and the last beam meet the line."""
    alpha, rho, v_alpha, cov, v_rho, chi2 = line
    v_alpha, cov, v_rho = add_flatness(alpha, rho, v_alpha, cov, v_rho, first, last, flatness)
    row[0], row[1], row[2], row[3] = np.arctan2(np.sin(alpha), np.cos(alpha)), rho, chi2, dof
    row[4], row[5], row[6], row[7] = v_alpha, cov, cov, v_rho
    for i, bearing in enumerate((first, last)):
        reach = rho / np.cos(bearing - alpha)
        row[8 + 2 * i], row[9 + 2 * i] = reach * np.cos(bearing), reach * np.sin(bearing)
