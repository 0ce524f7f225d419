"""Kernels of line extraction that join pieces of one wall."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner
from spplanes.lines._kernels import N_SUMS, fit_sums, sum_of


@inner(cache=True)
def add_flatness(line, first, last, flatness):
    """A line (alpha, rho, var alpha, cov, var rho) of a wall straight to `flatness` (rms) from bearing first to last.
    The shift at its middle varies by flatness, its direction by sqrt(12) flatness / length: what a deviation of that
    size, as large at one end as at the other, does to the fitted line."""
    alpha, rho, v_alpha, cov, v_rho = line
    a, b = rho * np.tan(first - alpha), rho * np.tan(last - alpha)
    middle, turn = 0.5 * (a + b), 12.0 * (flatness / (b - a)) ** 2
    return alpha, rho, v_alpha + turn, cov + middle * turn, v_rho + flatness * flatness + middle * middle * turn


@inner(cache=True)
def polar_of_sums(m, first, last, flatness):
    """(alpha, rho, var alpha, cov, var rho) of the beams whose sums are `m`, the flatness of the wall in it."""
    u, v, _ = fit_sums(m)
    det = m[0] * m[2] - m[1] * m[1]
    alpha, rho = np.arctan2(v, u), 1.0 / np.hypot(u, v)
    au, av = -v * rho * rho, u * rho * rho
    ru, rv = -u * rho**3, -v * rho**3
    v_alpha = (au * au * m[2] - 2.0 * au * av * m[1] + av * av * m[0]) / det
    cov = (au * ru * m[2] - (au * rv + av * ru) * m[1] + av * rv * m[0]) / det
    v_rho = (ru * ru * m[2] - 2.0 * ru * rv * m[1] + rv * rv * m[0]) / det
    return add_flatness((alpha, rho, v_alpha, cov, v_rho), first, last, flatness)


@inlined
def flat_chi2(bearings, m, piece, other_m, other_piece, flatness):
    """Chi2, 2 dof, of two pieces being one wall that is straight to `flatness`."""
    p = polar_of_sums(m, bearings[piece[0]], bearings[piece[1] - 1], flatness)
    q = polar_of_sums(other_m, bearings[other_piece[0]], bearings[other_piece[1] - 1], flatness)
    turn = (q[0] - p[0] + np.pi) % (2.0 * np.pi) - np.pi
    shift = q[1] - p[1]
    a, b, c = p[2] + q[2], p[3] + q[3], p[4] + q[4]
    return (c * turn * turn - 2.0 * b * turn * shift + a * shift * shift) / (a * c - b * b)


@inlined
def may_bridge(beams, u, v, pieces, both, bounds):
    """True when line (u, v) may join both pieces: what lies between neither contradicts nor exceeds them."""
    bearings, ranges, sigmas = beams.bearings, beams.ranges, beams.sigmas
    (i, j), (max_through, max_step) = both, bounds
    through = 0
    for k in range(pieces[i, 1], pieces[j, 0]):
        inverse = u * np.cos(bearings[k]) + v * np.sin(bearings[k])
        if inverse <= 0.0 or ranges[k] > 1.0 / inverse + 3.0 * sigmas[k]:
            through += 1
    if through > max_through:
        return False
    alpha = np.arctan2(v, u)
    t = np.empty(4)
    ends = (pieces[i, 0], pieces[i, 1] - 1, pieces[j, 0], pieces[j, 1] - 1)
    for e in range(4):
        offset = bearings[ends[e]] - alpha
        if np.cos(offset) <= 0.0:
            return False
        t[e] = np.tan(offset)
    step = (bearings[ends[2]] - bearings[ends[1]]) % (2.0 * np.pi)
    return t[2] - t[1] <= t[1] - t[0] + t[3] - t[2] or step <= max_step


@inner(cache=True)
def merge(beams, moments, starts, is_round, bounds, flatness, gate):
    """Join pieces that are one line (chi2 with 2 dof): the label of each beam (V,), -1 for pieces under 3 beams.
    `bounds` are the most beams that may pass through between two pieces, and the widest step in bearing, rad."""
    n_pieces = starts.size - 1
    pieces = np.empty((n_pieces, 2), dtype=np.int64)
    sums, both = np.zeros((n_pieces, N_SUMS)), np.empty(N_SUMS)
    labels = np.empty(moments.shape[0], dtype=np.int64)
    count = 0
    for i in range(n_pieces):
        if starts[i + 1] - starts[i] < 3 or is_round[starts[i]]:
            labels[starts[i] : starts[i + 1]] = -1
            continue
        new = sum_of(moments, range(starts[i], starts[i + 1]))
        pieces[count, 0], pieces[count, 1] = starts[i], starts[i + 1]
        target = count
        for j in range(count - 1, -1, -1):
            for k in range(N_SUMS):
                both[k] = sums[j, k] + new[k]
            u, v, chi2 = fit_sums(both)
            gain = chi2 - fit_sums(sums[j])[2] - fit_sums(new)[2]
            if gain > gate and flatness > 0.0:
                gain = flat_chi2(beams.bearings, sums[j], pieces[j], new, pieces[count], flatness)
            if gain <= gate and may_bridge(beams, u, v, pieces, (j, count), bounds):
                target = j
                break
        labels[starts[i] : starts[i + 1]] = target
        if target == count:
            count += 1
        else:
            pieces[target, 1] = starts[i + 1]
        for k in range(N_SUMS):
            sums[target, k] += new[k]
    return labels
