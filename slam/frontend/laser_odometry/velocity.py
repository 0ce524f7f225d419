"""The velocity of a body between stamped scans: a Gauss-Markov process, its clock uncertain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.config import CoastingConfig
from spplanes._check import FloatArray

#: Intervals count as at most so many times what three in four stay below: in a pause no scan was late.
_LONGEST, _USUALLY = 3.0, 0.75


class VelocityFilter:
    """A Kalman filter of the velocity (x, y, theta) in the body's axes, by the steps that scans were found to make.

    What is forgotten goes back to what bodies have: none, with the standard deviations of the rules. The time between
    two scans is as uncertain as their stamps; so is the step that a velocity makes of it, and the velocity of a step.

    Args:
        rules: usual velocities, and how fast they change.
        stamp_sigma_s: standard deviation of a scan's stamp, s.
    """

    def __init__(self, rules: CoastingConfig, stamp_sigma_s: float = 0.0) -> None:
        axes = np.array((0, 0, 1))
        self._usual = np.array((rules.speed_sigma_m_per_s, rules.turn_sigma_rad_per_s))[axes]
        self._change = np.array((rules.acceleration_sigma_m_per_s2, rules.turn_change_sigma_rad_per_s2))[axes]
        self._clock = 2.0 * stamp_sigma_s**2
        self._mean, self._variance = np.zeros(3), np.square(self._usual)
        self._before_s = 0.0

    def ahead(self, seconds: float) -> tuple[FloatArray, FloatArray]:
        """The step (3,) of the next so many seconds, and its covariance (3, 3)."""
        mean, variance = self._later(seconds)
        late = self._clock * np.outer(mean, mean)
        return mean * seconds, late + np.diag(variance * (seconds**2 + self._clock))

    def learn(self, seconds: float, moved: FloatArray, covariance: FloatArray) -> None:
        """Take in a step (3,) of so many seconds, with its covariance (3, 3)."""
        mean, variance = self._later(seconds)
        noise = (np.diag(covariance) + self._clock * (np.square(mean) + variance)) / seconds**2
        gain = variance / (variance + noise)
        self._mean, self._variance = mean + gain * (moved / seconds - mean), (1.0 - gain) * variance
        self._before_s = seconds

    def _later(self, seconds: float) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of the velocity during the next so many seconds."""
        changed = np.square(self._change) * (max(seconds, self._before_s) ** 2 + self._clock)
        kept = np.square(self._usual) / (np.square(self._usual) + changed)
        return np.sqrt(kept) * self._mean, kept * (self._variance + changed)


def stamp_sigma(stamps_ns: Sequence[int]) -> float:
    """Standard deviation of the stamps of scans that a sensor takes at a steady rate, s, shape of the stamps (N,).

    A stamp that is late makes the interval before it longer and the one after it shorter by as much: the covariance of
    neighbouring intervals is minus the variance of a stamp. Scans left out, and pauses, make no such pairs.
    """
    intervals = 1e-9 * np.diff(np.asarray(stamps_ns, dtype=np.int64))
    if len(intervals) < 3:
        return 0.0
    intervals = np.minimum(intervals, _LONGEST * np.quantile(intervals, _USUALLY))
    away = intervals - intervals.mean()
    return float(np.sqrt(max(-np.mean(away[1:] * away[:-1]), 0.0)))
