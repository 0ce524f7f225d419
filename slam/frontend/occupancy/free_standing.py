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

    A thing is what lies between two gaps. It stands free where the returns beside it, if any, are farther from the
    sensor: how wide it is, is seen then.

    Args:
        away: returns in the order of the beams, from the sensor, shape (N, 2), m.
        angle_step: between two beams, rad.
    """
    if not len(away):
        return np.empty(0, dtype=np.int64)
    ranges = np.hypot(away[:, 0], away[:, 1])
    apart = np.hypot(*np.diff(away, axis=0).T)
    ends = np.flatnonzero(apart >= np.maximum(LEAST_GAP_M, GAP_STEPS * angle_step * ranges[:-1]))
    first, last = np.concatenate(([0], ends + 1)), np.concatenate((ends, [len(away) - 1]))
    beside = np.concatenate(([np.inf], ranges, [np.inf]))
    free = (beside[first] > ranges[first]) & (beside[last + 2] > ranges[last])
    free &= np.hypot(*(away[last] - away[first]).T) < MOVABLE_M
    numbers = np.where(free, np.cumsum(free) - 1, -1)
    return np.repeat(numbers, last - first + 1)
