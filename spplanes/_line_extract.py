"""The kernel behind `spplanes.extract_lines`: from ordered returns to lines and the beams that support them."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes._line_fit import fit_beams, grow, trim, turning
from spplanes._line_kernels import beam_moments, find_breaks, fit_sums, merge, order_beams, refine, split
from spplanes._line_round import find_round

#: Columns of a result row: alpha, rho, var alpha, cov, var rho, chi2, first bearing, last bearing.
N_RESULT = 8


@njit(cache=True)
def label_beams(bearings, ranges, sigmas, breaks, max_missing, significance, max_turning):
    """Split, take out what is round, merge: the label of each return (V,) and the number of labels."""
    moments = beam_moments(bearings, ranges, sigmas)
    starts = refine(moments, breaks, split(moments, breaks, significance), significance)
    is_round = find_round(bearings, ranges, sigmas, moments, breaks, starts, significance, 0.5 * max_turning)
    gate = -2.0 * np.log(significance)
    return merge(bearings, ranges, sigmas, moments, starts, is_round, max_missing, gate)


@njit(cache=True)
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


@njit(cache=True)
def fit_label(bearings, ranges, sigmas, breaks, labels, label, gate):
    """Maximum-likelihood line of one label, its ends trimmed and grown: (line, members)."""
    members = np.nonzero(labels == label)[0]
    total = np.zeros(6)
    for k in range(members.size):
        total += beam_moments(bearings[members[k : k + 1]], ranges[members[k : k + 1]], sigmas[members[k : k + 1]])[0]
    u, v, _ = fit_sums(total)
    norm = np.hypot(u, v)
    line = fit_beams(bearings, ranges, sigmas, members, np.arctan2(v, u), 1.0 / norm)
    for _ in range(2):
        if not np.isfinite(line[5]):
            break
        before = members.size
        trimmed = trim(bearings, ranges, sigmas, members, line, gate)
        for k in members:
            labels[k] = -1
        for k in trimmed:
            labels[k] = label
        members = grow(bearings, ranges, sigmas, breaks, labels, label, trimmed, line, gate)
        line = fit_beams(bearings, ranges, sigmas, members, line[0], line[1])
        if trimmed.size == before and members.size == before:
            break
    return line, members


@njit(cache=True)
def is_line(bearings, ranges, sigmas, members, line, min_points, max_turning, n_sigma, max_misfit):
    """True when the beams are enough, fit, and are no arc that turns by `max_turning`."""
    n = members.size
    if n < min_points or not np.isfinite(line[5]) or line[5] > max_misfit * (n - 2):
        return False
    arc, arc_sigma = turning(bearings, ranges, sigmas, members, line)
    return abs(arc) + n_sigma * arc_sigma < max_turning


@njit(cache=True)
def extract(
    ranges, angles, sigmas, range_min, range_max, max_missing, significance, min_points, max_turning, max_misfit
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
        labels, n_labels = label_beams(a, r, s, breaks, max_missing, significance, max_turning)
        if attempt == 1 or widest > max_step:
            break
        cut = ring_start(labels, n_labels)
        if cut == 0:
            break
        beams = np.concatenate((beams[cut:], beams[:cut]))
    for label in range(n_labels):
        line, members = fit_label(a, r, s, breaks, labels, label, gate)
        if is_line(a, r, s, members, line, min_points, max_turning, 3.0, max_misfit):
            rows[n_lines, :6] = np.array(line)
            rows[n_lines, 6], rows[n_lines, 7] = a[members[0]], a[members[-1]]
            support[n_support : n_support + members.size] = beams[members]
            counts[n_lines] = members.size
            n_support += members.size
            n_lines += 1
    return rows[:n_lines], support[:n_support], counts[:n_lines]
