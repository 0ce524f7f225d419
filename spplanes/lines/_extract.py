"""The kernel behind `spplanes.extract_lines`: from ordered returns to lines and the beams that support them."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inner, njit
from spplanes.lines._core import drop_borders, drop_doubtful_ends, start_line
from spplanes.lines._fit import fit_beams, grow, line_sigmas, trim, turning
from spplanes.lines._kernels import (
    beam_moments,
    find_breaks,
    order_beams,
    refine,
    slope_sigmas,
    split,
)
from spplanes.lines._merge import add_flatness, merge
from spplanes.lines._round import find_round

#: Columns of a result row: alpha, rho, chi2, dof, covariance (4), end points (4).
N_RESULT = 12


@inner(cache=True)
def label_beams(
    bearings, cosines, sines, ranges, sigmas, moments, breaks, max_missing, max_step, flatness, significance,
    max_turning,
):  # fmt: skip
    """Split, take out what is round, merge: label of each return (V,), whether it is undecided (V,), label count."""
    starts, undecided = refine(moments, breaks, split(moments, breaks, significance), significance)
    arc = 0.5 * max_turning
    is_round = find_round(bearings, cosines, sines, ranges, sigmas, moments, breaks, starts, significance, arc)
    gate = -2.0 * np.log(significance)
    labels, n_labels = merge(bearings, ranges, sigmas, moments, starts, is_round, max_missing, max_step, flatness, gate)
    return labels, undecided, n_labels


@inner(cache=True)
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


@inner(cache=True)
def fit_label(
    bearings, cosines, sines, ranges, sigmas, moments, bearing_sigma, breaks, undecided, labels, members, gate
):  # fmt: skip
    """Line of a label's beams; the beams on it, ends trimmed and grown; how many were decided, how many of them fitted.

    Decided beams beside another surface are on the line but not in the fit.
    """
    label = labels[members[0]]
    core = members[~undecided[members]]
    core = drop_doubtful_ends(moments, core)
    n_borders = core.size
    core = drop_borders(breaks, labels, core)
    n_borders -= core.size
    line = start_line(moments, core)
    if bearing_sigma > 0.0:
        sigmas = line_sigmas(bearings, sigmas, np.arange(bearings.size), line[0], line[1], bearing_sigma)
    for _ in range(2):
        if core.size < 3:
            break
        line = fit_beams(cosines, sines, ranges, sigmas, core, line[0], line[1])
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


@inner(cache=True)
def members_of(labels, count):
    """The beams of each label, one label after the other, and where those of each begin (count + 1,)."""
    begins = np.zeros(count + 1, dtype=np.int64)
    for label in labels:
        if label >= 0:
            begins[label + 1] += 1
    for label in range(count):
        begins[label + 1] += begins[label]
    members, at = np.empty(begins[count], dtype=np.int64), begins.copy()
    for k in range(labels.size):
        if labels[k] >= 0:
            members[at[labels[k]]] = k
            at[labels[k]] += 1
    return members, begins


@inner(cache=True)
def is_line(
    bearings, cosines, sines, ranges, sigmas, members, n_decided, n_fitted, line, min_points, max_turning,
    max_curvature, max_misfit,
):  # fmt: skip
    """True when the beams suffice, fit, are no arc that turns by `max_turning`, and (alpha, rho) is Gaussian."""
    if n_decided < max(min_points, 3) or not np.isfinite(line[5]) or line[5] > max_misfit * (n_fitted - 2):
        return False
    _, rho, v_alpha, cov, v_rho, _ = line
    if 0.5 * rho * v_alpha > max_curvature * np.sqrt(v_rho - cov * cov / v_alpha):
        return False
    arc, arc_sigma = turning(bearings, cosines, sines, ranges, sigmas, members, line)
    return abs(arc) + 3.0 * arc_sigma < max_turning


@inner(cache=True)
def label_scan(
    ranges, angles, cosines, sines, sigmas, bearing_sigma, flatness, range_min, range_max, max_missing, significance,
    max_turning,
):  # fmt: skip
    """Order and label the returns: beams (V,), breaks (V,), labels (V,), undecided (V,), number of labels."""
    beams, widest, step = order_beams(ranges, angles, range_min, range_max)
    max_step = (max_missing + 1.5) * step
    s = slope_sigmas(angles[beams], ranges[beams], sigmas[beams], bearing_sigma)
    moments = beam_moments(cosines[beams], sines[beams], ranges[beams], s)
    breaks = find_breaks(angles[beams], ranges[beams], s, max_step, -2.0 * np.log(significance))
    n_cuts = 0
    while True:
        labels, undecided, n_labels = label_beams(
            angles[beams], cosines[beams], sines[beams], ranges[beams], s, moments, breaks, max_missing, max_step,
            flatness, significance, max_turning,
        )  # fmt: skip
        cut = ring_start(labels, n_labels)
        if n_cuts == 1 or widest > max_step or cut == 0:
            return beams, breaks, labels, undecided, n_labels
        turned = np.concatenate((np.arange(cut, beams.size), np.arange(cut)))
        beams, s, moments, breaks = beams[turned], s[turned], moments[turned], breaks[turned]
        n_cuts += 1


@njit(cache=True)
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
    cosines, sines = np.cos(angles), np.sin(angles)
    beams, breaks, labels, undecided, n_labels = label_scan(
        ranges, angles, cosines, sines, sigmas, bearing_sigma, flatness, range_min, range_max, max_missing,
        significance, max_turning,
    )  # fmt: skip
    a, r, s = angles[beams], ranges[beams], sigmas[beams]
    cosines, sines = cosines[beams], sines[beams]
    moments = beam_moments(cosines, sines, r, s)
    of_labels, begins = members_of(labels, n_labels)
    rows = np.empty((n_labels, N_RESULT))
    support = np.empty(beams.size, dtype=np.int64)
    counts = np.zeros(n_labels, dtype=np.int64)
    n_lines = n_support = 0
    for label in range(n_labels):
        line, members, n_decided, n_fitted = fit_label(
            a, cosines, sines, r, s, moments, bearing_sigma, breaks, undecided, labels,
            of_labels[begins[label] : begins[label + 1]], -2.0 * np.log(significance),
        )  # fmt: skip
        if is_line(
            a, cosines, sines, r, s, members, n_decided, n_fitted, line, min_points, max_turning, max_curvature,
            max_misfit,
        ):  # fmt: skip
            write_row(rows[n_lines], line, n_fitted - 2, a[members[0]], a[members[-1]], flatness)
            support[n_support : n_support + members.size] = beams[members]
            counts[n_lines] = members.size
            n_support += members.size
            n_lines += 1
    return rows[:n_lines], support[:n_support], counts[:n_lines]


@inner(cache=True)
def write_row(row, line, dof, first, last, flatness):
    """Fill a result row; the end points are where the first and the last beam meet the line."""
    alpha, rho, v_alpha, cov, v_rho, chi2 = line
    v_alpha, cov, v_rho = add_flatness(alpha, rho, v_alpha, cov, v_rho, first, last, flatness)
    alpha_in_turn = np.arctan2(np.sin(alpha), np.cos(alpha))
    row[0], row[1], row[2], row[3] = alpha_in_turn if alpha_in_turn > -np.pi else np.pi, rho, chi2, dof
    row[4], row[5], row[6], row[7] = v_alpha, cov, cov, v_rho
    for i, bearing in enumerate((first, last)):
        reach = rho / np.cos(bearing - alpha)
        row[8 + 2 * i], row[9 + 2 * i] = reach * np.cos(bearing), reach * np.sin(bearing)
