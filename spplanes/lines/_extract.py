"""The kernels behind `spplanes.extract_lines`: from ordered returns to lines and the beams that support them."""

from __future__ import annotations

import math

import numpy as np

from spplanes._jit import inlined, inner, njit
from spplanes.lines._core import between, decided, drop_borders, drop_doubtful_ends, start_line
from spplanes.lines._fit import fit_beams, grow, line_sigmas, relabel, trim, turning
from spplanes.lines._kernels import (
    N_SUMS,
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


#: Rows of an ordered scan: bearing, cosine, sine, range, its standard deviation without that of the bearing, with it.
BEARING, COSINE, SINE, RANGE, SIGMA, SLOPE_SIGMA, N_ROWS = range(7)


@njit(cache=True)
def order_scan(ranges, angles, sigmas, bearing_sigma, range_min, range_max, max_missing, gate):
    """Returns in order: beams (V,), their rows (N_ROWS, V), moments, breaks (V,); the widest gap, the largest step."""
    beams, widest, step = order_beams(ranges, angles, range_min, range_max)
    rows = np.empty((N_ROWS, beams.size))
    for k in range(beams.size):
        beam = beams[k]
        rows[BEARING, k], rows[RANGE, k], rows[SIGMA, k] = angles[beam], ranges[beam], sigmas[beam]
        rows[COSINE, k], rows[SINE, k] = np.cos(angles[beam]), np.sin(angles[beam])
    slope_sigmas(rows[BEARING], rows[RANGE], rows[SIGMA], bearing_sigma, rows[SLOPE_SIGMA])
    moments = beam_moments(rows[COSINE], rows[SINE], rows[RANGE], rows[SLOPE_SIGMA])
    max_step = (max_missing + 1.5) * step
    return (
        beams,
        rows,
        moments,
        find_breaks(rows[BEARING], rows[RANGE], rows[SLOPE_SIGMA], max_step, gate),
        widest,
        max_step,
    )


@njit(cache=True)
def label_scan(beams, scan, moments, breaks, widest, max_missing, max_step, flatness, significance, max_turning):
    """Label the returns: beams, scan, breaks in order, labels (V,), undecided (V,), number of labels."""
    arc, gate, cut = 0.5 * max_turning, -2.0 * np.log(significance), 0
    while True:
        bearings, ranges, sigmas = scan[BEARING], scan[RANGE], scan[SLOPE_SIGMA]
        starts, undecided = refine(moments, breaks, split(moments, breaks, significance), significance)
        is_round = find_round(
            bearings, scan[COSINE], scan[SINE], ranges, sigmas, moments, breaks, starts, significance, arc
        )
        labels, n_labels = merge(
            bearings, ranges, sigmas, moments, starts, is_round, max_missing, max_step, flatness, gate
        )
        if cut == 0 and widest <= max_step:
            cut = ring_start(labels, n_labels)
            if cut > 0:
                beams, scan, moments, breaks = turned(beams, scan, moments, breaks, cut)
                continue
        return beams, scan, breaks, labels, undecided, n_labels


@inlined
def turned(beams, scan, moments, breaks, cut):
    """The same returns, the one at the cut first."""
    order, rows, sums, gaps = np.empty_like(beams), np.empty_like(scan), np.empty_like(moments), np.empty_like(breaks)
    for k in range(beams.size):
        old = k + cut if k + cut < beams.size else k + cut - beams.size
        order[k], gaps[k] = beams[old], breaks[old]
        for i in range(N_ROWS):
            rows[i, k] = scan[i, old]
        for i in range(N_SUMS):
            sums[k, i] = moments[old, i]
    return order, rows, sums, gaps


@inlined
def ring_start(labels, count):
    """Where a closed ring can be cut without cutting a line: the first beam of one that no other bridges; else 0."""
    first, last = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    for k in range(labels.size):
        if labels[labels.size - 1 - k] >= 0:
            first[labels[labels.size - 1 - k]] = labels.size - 1 - k
        if labels[k] >= 0:
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
    core = drop_doubtful_ends(moments, decided(members, undecided))
    n_borders = core.size
    core = drop_borders(breaks, labels, core)
    n_borders -= core.size
    line = start_line(moments, core)
    if bearing_sigma > 0.0:
        sigmas = line_sigmas(bearings, sigmas, line[0], line[1], bearing_sigma)
    for _ in range(2):
        if core.size < 3:
            break
        line = fit_beams(cosines, sines, ranges, sigmas, core, line[0], line[1])
        if not np.isfinite(line[5]):
            break
        relabel(labels, members, -1)
        members = trim(bearings, ranges, sigmas, members, line, gate)
        n_before = core.size
        core = between(core, members[0], members[-1])
        members = grow(bearings, ranges, sigmas, breaks, labels, members, line, gate)
        relabel(labels, members, label)
        if core.size == n_before:
            break
    return line, members, core.size + n_borders, core.size


@inlined
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


@inlined
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
    gate = -2.0 * math.log(significance)
    beams, scan, moments, breaks, widest, max_step = order_scan(
        ranges, angles, sigmas, bearing_sigma, range_min, range_max, max_missing, gate
    )
    beams, scan, breaks, labels, undecided, n_labels = label_scan(
        beams, scan, moments, breaks, widest, max_missing, max_step, flatness, significance, max_turning
    )
    return fit_labels(
        beams, scan, breaks, labels, undecided, n_labels, bearing_sigma, flatness, gate, min_points, max_turning,
        max_curvature, max_misfit,
    )  # fmt: skip


@njit(cache=True)
def fit_labels(
    beams, scan, breaks, labels, undecided, n_labels, bearing_sigma, flatness, gate, min_points, max_turning,
    max_curvature, max_misfit,
):  # fmt: skip
    """The line of every label that is one: see `extract`."""
    a, cosines, sines, r, s = scan[BEARING], scan[COSINE], scan[SINE], scan[RANGE], scan[SIGMA]
    moments = beam_moments(cosines, sines, r, s)
    of_labels, begins = members_of(labels, n_labels)
    rows, support = np.empty((n_labels, N_RESULT)), np.empty(beams.size, dtype=np.int64)
    counts = np.empty(n_labels, dtype=np.int64)
    n_lines = n_support = 0
    for label in range(n_labels):
        line, members, n_decided, n_fitted = fit_label(
            a, cosines, sines, r, s, moments, bearing_sigma, breaks, undecided, labels,
            of_labels[begins[label] : begins[label + 1]], gate,
        )  # fmt: skip
        if is_line(
            a, cosines, sines, r, s, members, n_decided, n_fitted, line, min_points, max_turning, max_curvature,
            max_misfit,
        ):  # fmt: skip
            write_row(rows[n_lines], line, n_fitted - 2, a[members[0]], a[members[-1]], flatness)
            for k in members:
                support[n_support] = beams[k]
                n_support += 1
            counts[n_lines] = members.size
            n_lines += 1
    return rows[:n_lines], support[:n_support], counts[:n_lines]


@inlined
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
