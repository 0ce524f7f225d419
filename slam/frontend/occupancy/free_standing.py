"""What stands free in a scan: small things in front of all beside them, which may be on their way, as people are."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray

#: Neighbouring returns further apart than so many steps of the beams at their range, and m, are of two surfaces.
GAP_STEPS, LEAST_GAP_M = 6.0, 0.15
#: What is narrower and stands free may move, m.
MOVABLE_M = 1.0


def free_standing(away: FloatArray, angle_step: float) -> np.ndarray:
    """Which thing that stands free each return is of, shape (N,): a number from 0 on; -1: of none.

    A thing is what lies between two gaps. It stands free where the returns on both sides of it are farther from the
    sensor; beyond the ends of a fan nothing is known to be nearer, and what is cut off there may walk as well. A fan
    without ends goes on from its last return to its first.

    Args:
        away: returns in the order of the beams, from the sensor, shape (N, 2), m.
        angle_step: between two beams, rad.
    """
    none = np.full(len(away), -1, dtype=np.int64)
    if len(away) < 3:
        return none
    ranges = np.hypot(away[:, 0], away[:, 1])
    gaps = np.hypot(*(np.roll(away, -1, axis=0) - away).T) >= np.maximum(LEAST_GAP_M, GAP_STEPS * angle_step * ranges)
    between_ends = np.arctan2(away[0, 1], away[0, 0]) - np.arctan2(away[-1, 1], away[-1, 0])
    is_closed = abs(np.remainder(between_ends + np.pi, 2.0 * np.pi) - np.pi) < GAP_STEPS * angle_step
    if is_closed and not gaps.any():
        return none
    start = int(np.argmax(gaps)) + 1 if is_closed else 0  # a thing begins here
    turned, near, ends = np.roll(away, -start, axis=0), np.roll(ranges, -start), np.roll(gaps, -start)
    ends[-1] = True
    last = np.flatnonzero(ends)
    first = np.concatenate(([0], last[:-1] + 1))
    before, after = near[first - 1], near[(last + 1) % len(near)]
    if not is_closed:
        before[0] = after[-1] = np.inf
    free = (before > near[first]) & (after > near[last])
    extent = np.maximum.reduceat(turned, first) - np.minimum.reduceat(turned, first)
    free &= np.hypot(extent[:, 0], extent[:, 1]) < MOVABLE_M
    numbers = np.where(free, np.cumsum(free) - 1, -1)
    return np.roll(np.repeat(numbers, last - first + 1), start)
