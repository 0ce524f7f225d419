"""Kernels of line extraction: the beams of a label that its fit rests on, and the line it starts from."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner
from spplanes.lines._kernels import N_SUMS, fit_sums

#: 99 % quantiles of chi2 with 1, 2, 3 dof: what that many end beams may add to the chi2 of the others.
END_GATES = np.array((7.88, 10.6, 12.84))


@inlined
def drop_borders(breaks, labels, members):
    """Members without those beside a return that is not on the line; all of them when fewer than three would be left.

    Such a beam may already be on what joins the two surfaces. Of a door jamb hit by one beam within its noise of the
    wall no residual tells, yet at the end of the line it turns it.
    """
    kept, count = np.empty(members.size, dtype=np.int64), 0
    for k in members:
        after = (k + 1) % labels.size
        begins = breaks[k] < 2 and labels[k - 1] != labels[k]
        ends = breaks[after] < 2 and labels[after] != labels[k]
        if not (begins or ends):
            kept[count] = k
            count += 1
    return kept[:count] if count >= 3 else members


@inlined
def decided(members, undecided):
    """Members without the undecided ones."""
    kept, count = np.empty(members.size, dtype=np.int64), 0
    for k in members:
        if not undecided[k]:
            kept[count] = k
            count += 1
    return kept[:count]


@inlined
def between(members, first, last):
    """Members, which ascend, from the first beam to the last."""
    low, high = 0, members.size
    while low < high and members[low] < first:
        low += 1
    while high > low and members[high - 1] > last:
        high -= 1
    return members[low:high]


@inner(cache=True)
def drop_doubtful_ends(moments, members):
    """Members without the few beams at each end that the others contradict: those of a surface just beyond."""
    low, high = 0, members.size
    total = sum_of(moments, members)
    whole = fit_sums(total)[2]
    for side in range(2):
        m = 0
        rest = total.copy()
        while m < END_GATES.size and high - low - m > 4:
            beam = members[low + m] if side == 0 else members[high - 1 - m]
            for i in range(N_SUMS):
                rest[i] -= moments[beam, i]
            m += 1
            chi2 = fit_sums(rest)[2]
            if whole - chi2 > END_GATES[m - 1]:
                low, high = (low + m, high) if side == 0 else (low, high - m)
                total, whole, m = rest.copy(), chi2, 0
    return members[low:high]


@inlined
def start_line(moments, members):
    """The line of the inverse-range fit, as `fit_beams` returns it."""
    u, v, chi2 = fit_sums(sum_of(moments, members))
    return np.arctan2(v, u), 1.0 / np.hypot(u, v), 0.0, 0.0, 0.0, chi2


@inner(cache=True)
def sum_of(moments, members):
    """The six sums of some beams."""
    total = np.zeros(N_SUMS)
    for k in members:
        for i in range(N_SUMS):
            total[i] += moments[k, i]
    return total
