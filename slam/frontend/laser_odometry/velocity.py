"""The velocity of a body between stamped scans: a Gauss-Markov process, its clock uncertain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.config import CoastingConfig
from slam.frontend.steadiness import Steadiness, Usual
from spplanes._check import FloatArray

#: A step tells how the body moves along an axis where what was seen has more than this share in it.
_TOLD = 0.5


class VelocityFilter:
    """A Kalman filter of the velocity (x, y, theta) in the body's axes, by the steps that scans were found to make.

    What is forgotten goes back to what bodies have: none, with the standard deviations of the rules. The time between
    two scans is as uncertain as their stamps; so is the step that a velocity makes of it, and the velocity of a step.

    How far velocity changes is what any body may, by the rules. Where nobody measured the motion it is what this body
    does, and how rarely it does not keep to that, by the steps of late that were told (`slam.frontend.steadiness`).

    Args:
        rules: usual velocities, and how fast they change.
        stamp_sigma_s: standard deviation of a scan's stamp, s.
    """

    def __init__(self, rules: CoastingConfig, stamp_sigma_s: float = 0.0) -> None:
        axes = np.array((0, 0, 1))
        self._velocities = np.array((rules.speed_sigma_m_per_s, rules.turn_sigma_rad_per_s))[axes]
        self._change = np.array((rules.acceleration_sigma_m_per_s2, rules.turn_change_sigma_rad_per_s2))[axes]
        self._clock = 2.0 * stamp_sigma_s**2
        self._mean, self._variance = np.zeros(3), np.square(self._velocities)
        self._before_s = 0.0
        self._steadiness = [Steadiness(1) for _ in axes]  # an axis along which nothing is told forgets nothing

    def ahead(self, seconds: float) -> tuple[FloatArray, FloatArray]:
        """The step (3,) of the next so many seconds, and its covariance (3, 3), of any body."""
        return self._step(seconds, self._any_change(seconds))

    def usually(self, seconds: float) -> tuple[FloatArray, FloatArray, float]:
        """The same of this one while it keeps its velocity as it does, and how likely it is that it does."""
        usual, change = self._usual(), self._any_change(seconds)
        kept = change - usual._replace(rates=np.zeros(3)).less(change)
        return *self._step(seconds, kept), float(np.prod(1.0 - usual.rates))

    def learn(self, seconds: float, moved: FloatArray, covariance: FloatArray) -> None:
        """Take in a step (3,) of so many seconds, with its covariance (3, 3)."""
        self._take(seconds, moved, np.diag(covariance), self._any_change(seconds))

    def learn_unmeasured(
        self, seconds: float, moved: FloatArray, covariance: FloatArray, expected: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        """The same of a step that was drawn to what was expected of it, and that this body made as it moves.

        Args:
            seconds: how long it took.
            moved: where it led, by what was seen and what was expected together, shape (3,).
            covariance: of it by what was seen alone, shape (3, 3).
            expected: the step (3,) that was expected, and its covariance (3, 3).

        Returns:
            Covariance (3, 3) of such a step without what was seen of it, but for whether it was a rare one.
        """
        change, seen, before = self._any_change(seconds), np.diag(covariance), np.diag(expected[1])
        mean, variance = self._later(np.zeros(3))
        gain = before / (before + seen)
        off = (moved - expected[0]) / np.maximum(gain, _TOLD)  # what was seen less is not to be had back
        known = variance * seconds**2 + self._clock * (np.square(mean) + variance) + seen
        steps = off, change * seconds**2, known
        made = self._usual().seen(*steps)
        for axis in np.flatnonzero(gain > _TOLD):
            one = slice(axis, axis + 1)
            self._steadiness[axis].learn(off[one], steps[1][one], known[one], np.ones(1, dtype=bool))
        change = change - made.less(change)
        _, without = self._step(seconds, change)
        self._take(seconds, expected[0] + off, seen, change)
        return without

    def _step(self, seconds: float, changed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The next step and its covariance, by variances (3,) of the change of velocity."""
        mean, variance = self._later(changed)
        late = self._clock * np.outer(mean, mean)
        return mean * seconds, late + np.diag(variance * (seconds**2 + self._clock))

    def _take(self, seconds: float, moved: FloatArray, variances: FloatArray, changed: FloatArray) -> None:
        mean, variance = self._later(changed)
        noise = (variances + self._clock * (np.square(mean) + variance)) / seconds**2
        gain = variance / (variance + noise)
        self._mean, self._variance = mean + gain * (moved / seconds - mean), (1.0 - gain) * variance
        self._before_s = seconds

    def _usual(self) -> Usual:
        each = [one.usual() for one in self._steadiness]
        return Usual(*(np.concatenate(parts) for parts in zip(*each, strict=True)))

    def _any_change(self, seconds: float) -> FloatArray:
        """Variances of how far any body may change its velocity until the next so many seconds, shape (3,)."""
        return np.square(self._change) * (max(seconds, self._before_s) ** 2 + self._clock)

    def _later(self, changed: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of the velocity during the next so many seconds."""
        kept = np.square(self._velocities) / (np.square(self._velocities) + changed)
        return np.sqrt(kept) * self._mean, kept * (self._variance + changed)


def stamp_sigma(stamps_ns: Sequence[int]) -> float:
    """Standard deviation of the stamps of scans that a sensor takes at a steady rate, s, shape of the stamps (N,).

    A stamp that is late makes the interval before it longer and the one after it shorter by as much: the covariance of
    neighbouring intervals is minus the variance of a stamp. Scans left out, and pauses, make no such pairs.
    """
    intervals = 1e-9 * np.diff(np.asarray(stamps_ns, dtype=np.int64))
    if len(intervals) < 3:
        return 0.0
    intervals = np.minimum(intervals, 3.0 * np.quantile(intervals, 0.75))  # in a pause no scan was late
    away = intervals - intervals.mean()
    return float(np.sqrt(max(-np.mean(away[1:] * away[:-1]), 0.0)))
