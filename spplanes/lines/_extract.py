"""The kernels behind `spplanes.extract_lines`: from ordered returns to lines and the beams that support them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner, njit
from spplanes.fitting._groups import group_by_label
from spplanes.lines._fit import (
    drop_borders,
    drop_doubtful_ends,
    fit_beams,
    grow,
    line_sigmas,
    trim,
    turning,
)
from spplanes.lines._kernels import (
    Beams,
    beam_moments,
    find_breaks,
    fit_sums,
    order_beams,
    refine,
    slope_sigmas,
    split,
    sum_of,
)
from spplanes.lines._merge import add_flatness, merge
from spplanes.lines._round import find_round


class Rules(NamedTuple):
    """What counts as a line, as kernels take it: the numbers of a `LineConfig`, the quantile of chi2 with 2 dof at its
    significance, and the flatness that is in the covariances, m."""

    significance: float
    gate: float
    min_points: int
    max_missing: int
    max_turning: float
    max_nonlinearity: float
    max_misfit: float
    bearing_sigma: float
    flatness: float
    range_min: float
    range_max: float
    stated: float


@inlined
def beams_of(scan, with_bearings):
    """The beams of an ordered scan (6, V), their noise with that of the bearing, the last row, or without."""
    return Beams(scan[0], scan[1], scan[2], scan[3], scan[5 if with_bearings else 4])


@njit(cache=True)
def order_scan(ranges, angles, sigmas, order, step, numbers):
    """Returns in order, a step apart: `beams_of` (6, V), moments, breaks (V,); the largest step in a line."""
    rules, scan = Rules(*numbers), np.empty((6, order.size))
    beams = beams_of(scan, False)
    for k in range(order.size):
        beam = order[k]
        beams.bearings[k], beams.ranges[k], beams.sigmas[k] = angles[beam], ranges[beam], sigmas[beam]
        beams.cosines[k], beams.sines[k] = np.cos(angles[beam]), np.sin(angles[beam])
    slope_sigmas(beams, rules.bearing_sigma, scan[5])
    beams, max_step = beams_of(scan, True), (rules.max_missing + 1.5) * step
    return scan, beam_moments(beams), find_breaks(beams, max_step, rules.gate), max_step


@njit(cache=True)
def label_scan(scan, moments, breaks, max_step, numbers):
    """Labels (V,) of the returns: which line each may be of, -1 = none."""
    rules, beams = Rules(*numbers), beams_of(scan, True)
    starts = refine(moments, breaks, split(moments, breaks, rules.significance), rules.significance)
    is_round = find_round(beams, moments, breaks, starts, rules.significance, 0.5 * rules.max_turning)
    bounds = rules.max_missing, max_step
    return merge(beams, moments, starts, is_round, bounds, rules.flatness, rules.gate)


def ring_start(members: np.ndarray, begins: np.ndarray) -> int:
    """Where a closed ring can be cut without cutting a line: the first beam of one that no other bridges; else 0. Beams
    members[begins[k] : begins[k + 1]] have label k."""
    first, last = members[begins[:-1]], members[begins[1:] - 1]
    return next((beam for beam in first[1:].tolist() if not ((first < beam) & (beam <= last)).any()), 0)


@inner(cache=True)
def fit_label(beams, moments, breaks, labels, members, rules):
    """Line of a label's beams; the beams on it, ends trimmed and grown; how many are surely, how many of them fitted:
    those beside another surface are on the line but not in the fit."""
    label = labels[members[0]]
    core = drop_doubtful_ends(moments, members)
    n_borders = core.size
    core = drop_borders(breaks, labels, core)
    n_borders -= core.size
    u, v, chi2 = fit_sums(sum_of(moments, core))  # in inverse ranges
    line = np.arctan2(v, u), 1.0 / np.hypot(u, v), 0.0, 0.0, 0.0, chi2
    if rules.bearing_sigma > 0.0:
        sigmas = line_sigmas(beams.bearings, beams.sigmas, line[0], line[1], rules.bearing_sigma)
        beams = Beams(beams.bearings, beams.cosines, beams.sines, beams.ranges, sigmas)
    for _ in range(2):
        if core.size < 3:
            break
        line = fit_beams(beams, core, line[0], line[1])
        if not np.isfinite(line[5]):
            break
        labels[members] = -1
        members = trim(beams, members, line, rules.gate)
        n_before = core.size
        first, last = np.searchsorted(core, members[0]), np.searchsorted(core, members[-1], side="right")
        core = core[first:last]
        members = grow(beams, breaks, labels, members, line, rules.gate)
        labels[members] = label
        if core.size == n_before:
            break
    return line, members, core.size + n_borders, core.size


@inlined
def is_line(beams, members, counts, line, rules):
    """True when the beams suffice, fit, are no arc that turns by `max_turning`, and (alpha, rho) is Gaussian."""
    n_sure, n_fitted = counts
    if n_sure < max(rules.min_points, 3) or not np.isfinite(line[5]) or line[5] > rules.max_misfit * (n_fitted - 2):
        return False
    _, rho, v_alpha, cov, v_rho, _ = line
    if 0.5 * rho * v_alpha > rules.max_nonlinearity * np.sqrt(v_rho - cov * cov / v_alpha):
        return False
    arc, arc_sigma = turning(beams, members, line)
    return abs(arc) + 3.0 * arc_sigma < rules.max_turning


def extract(
    ranges: FloatArray, angles: FloatArray, sigmas: FloatArray, rules: Rules
) -> tuple[FloatArray, np.ndarray, np.ndarray]:
    """Lines of one scan, the beams on them one line after the other, and their counts. Lines are rows (M, 12): alpha,
    rho, chi2, dof, covariance (4), end points (4)."""
    numbers = tuple(rules)  # named, they would cost each call from Python as much as half a scan
    order, widest, step = order_beams(ranges, angles, rules.range_min, rules.range_max)
    scan, moments, breaks, max_step = order_scan(ranges, angles, sigmas, order, step, numbers)
    labels = label_scan(scan, moments, breaks, max_step, numbers)
    _, *of_labels = group_by_label(labels, len(labels))
    if widest <= max_step and (cut := ring_start(*of_labels)):
        order, scan, breaks = (np.roll(one, -cut, axis=-1) for one in (order, scan, breaks))
        labels = label_scan(scan, np.roll(moments, -cut, axis=0), breaks, max_step, numbers)
        _, *of_labels = group_by_label(labels, len(labels))
    return fit_labels(order, scan, breaks, labels, *of_labels, numbers)


@njit(cache=True)
def fit_labels(order, scan, breaks, labels, of_labels, begins, numbers):
    """The line of every label that is one, see `extract`; beams of_labels[begins[k] : begins[k + 1]] have label k."""
    beams, rules = beams_of(scan, False), Rules(*numbers)
    moments, n_labels = beam_moments(beams), begins.shape[0] - 1
    rows, support = np.empty((n_labels, 12)), np.empty(order.size, dtype=np.int64)
    counts = np.empty(n_labels, dtype=np.int64)
    n_lines = n_support = 0
    for label in range(n_labels):
        own = of_labels[begins[label] : begins[label + 1]]
        line, members, n_sure, n_fitted = fit_label(beams, moments, breaks, labels, own, rules)
        if is_line(beams, members, (n_sure, n_fitted), line, rules):
            first, last = beams.bearings[members[0]], beams.bearings[members[-1]]
            write_row(rows[n_lines], line, n_fitted - 2, first, last, rules.stated)
            for k in members:
                support[n_support] = order[k]
                n_support += 1
            counts[n_lines] = members.size
            n_lines += 1
    return rows[:n_lines], support[:n_support], counts[:n_lines]


@inlined
def write_row(row, line, dof, first, last, flatness):
    """Fill a result row; the end points are where the first and the last beam meet the line."""
    alpha, rho, v_alpha, cov, v_rho = add_flatness(line[:5], first, last, flatness)
    alpha_in_turn = np.arctan2(np.sin(alpha), np.cos(alpha))
    row[0], row[1], row[2], row[3] = alpha_in_turn if alpha_in_turn > -np.pi else np.pi, rho, line[5], dof
    row[4], row[5], row[6], row[7] = v_alpha, cov, cov, v_rho
    for i, bearing in enumerate((first, last)):
        reach = rho / np.cos(bearing - alpha)
        row[8 + 2 * i], row[9 + 2 * i] = reach * np.cos(bearing), reach * np.sin(bearing)
