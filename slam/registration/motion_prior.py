"""What is expected of a motion that nobody measured: constant velocity, kept as steadily as this body has kept it."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from math import lgamma, log
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from slam.frontend.odometry import Motion
from spplanes._check import FloatArray

#: Steps that say how the odometry is, and the body moves, of late: wheels that slip on one floor hold on the next.
LATE = 60
#: How likely each of 25 factors is before a step is seen, the first of them 1: as likely that as any other.
HALF_AT_ONE = np.log(np.append(0.5, np.full(24, 0.5 / 24)))
#: Shares that are told apart of how far any body may change its velocity; before a step is seen all of it is likely.
_SHARES = np.geomspace(1.0, 0.03, 25)
#: How often it may change as any body may, not as it usually does: it starts, stops, turns.
_RATES = np.geomspace(0.5, 0.005, 9)
#: Of both, before a step is seen.
_PRIOR = HALF_AT_ONE[:, None, None] - np.log(len(_RATES))
#: Degrees of freedom of the changes, a Student's t: hands are not normal. And its density at 0 against the normal's.
_FREEDOM = 3.0
_AT_ZERO = lgamma(0.5 * _FREEDOM + 0.5) - lgamma(0.5 * _FREEDOM) - 0.5 * log(0.5 * _FREEDOM)
#: Squared scale of the t that is nearest to a normal distribution, of the variance of that.
_NORMAL = 0.63
#: An axis along which the variance of a step is less than this share of what was expected tells how the body moves.
_TOLD = 0.9


class MotionPrior(NamedTuple):
    """What is expected of one motion; deviations are in SP order along the axes of its end.

    Along each axis velocity changes as it did of late, or, rarely, as any body's may.
    """

    motion: Motion
    """By constant velocity, as wide as if the body might always change it so."""
    change: FloatArray
    """Variances of such a change, shape (6,); the rest of that covariance is of the velocity."""
    shares: FloatArray
    """Of the standard deviations of that, how far this body changes it as a rule, shape (6,)."""
    rates: FloatArray
    """How often it does not keep to that, shape (6,)."""

    def log_density(self, off: FloatArray, place: FloatArray | None = None) -> FloatArray:
        """Of a deviation (6,), seen with a covariance (6, 6), along each axis, up to the normal's constant, (6,)."""
        return np.logaddexp(*self._both(off, place))

    def log_likelihood(self, off: FloatArray) -> float:
        """Of a deviation (6,), 0 of none."""
        return float(np.sum(self.log_density(off) - self.log_density(np.zeros(6))))

    def learnt(self, off: FloatArray | None = None, place: FloatArray | None = None) -> Motion:
        """The motion, as wide as this body moves, but for the least of a step: it keeps on changing its velocity alike.

        Args:
            off: how far off a scan found the body, shape (6,): what it saw tells whether this is one of the rare
                steps. None: nobody looked.
            place: covariance of that, shape (6, 6).
        """
        rates = self.rates
        if off is not None:
            usual, rare = self._both(off, place)
            rates = np.exp(rare - np.logaddexp(usual, rare))
        floor_m, floor_rad, _ = self.motion.out_of_plane_sigmas
        usual_variances = _FREEDOM / (_FREEDOM - 2.0) * self.shares**2 * self.change
        usual_variances = np.maximum(usual_variances, np.repeat([floor_m, floor_rad], 3) ** 2)
        less = (1.0 - rates) * np.maximum(self.change - usual_variances, 0.0)
        return replace(self.motion, covariance=self.motion.covariance - np.diag(less))

    @property
    def before(self) -> FloatArray:
        """Variances of the velocity, shape (6,)."""
        return np.diag(self.motion.covariance) - self.change

    def _both(self, off: FloatArray, place: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Log densities of a usual and of a rare step, weighted, (6,) each."""
        known = self.before if place is None else self.before + np.diag(place)
        usual = np.log1p(-self.rates) + _log_density(off, self.shares**2 * self.change, known)
        return usual, np.log(self.rates) + _log_density(off, self.change, known)


class VelocityPrior:
    """How steadily a body keeps its velocity, along each axis, by its last steps.

    A robot drives on as it did, or turns; a camera in a hand starts and stops. Acceleration that any of them may have
    says little of a step of half a second: most places are within its reach.
    """

    def __init__(self) -> None:
        self._steps: deque[FloatArray] = deque(maxlen=LATE)

    def prior(self, motion: Motion, change: FloatArray) -> MotionPrior:
        """Of the next motion, by constant velocity; `change`: variances as of `MotionPrior`, shape (6,)."""
        posterior = np.broadcast_to(_PRIOR, (len(_SHARES), len(_RATES), 6)) + sum(self._steps)
        weights = np.exp(posterior - logsumexp(posterior, axis=(0, 1)))
        shares = np.exp(np.einsum("sra,s->a", weights, np.log(_SHARES)))
        return MotionPrior(motion, change, shares, np.einsum("sra,r->a", weights, _RATES))

    def learn(
        self, prior: MotionPrior, off: FloatArray, used: Motion | None = None, known: FloatArray | None = None
    ) -> None:
        """Take in how far off a step turned out to be, SP order along the axes of its end, shape (6,).

        Args:
            prior: what was expected of it.
            off: where the body turned out to be.
            used: what the estimate holds of it, None: nothing. Where nothing was seen the body is where it was
                expected, which says nothing of how it moves. Elsewhere an estimate is drawn to what was expected about
                as much as it errs: it is taken as it is.
            known: covariance of the estimate, shape (6, 6); None: it is known.
        """
        each = _log_density(off, _SHARES[:, None] ** 2 * prior.change, prior.before)[:, None]
        rates = _RATES[:, None]
        told = np.logaddexp(np.log1p(-rates) + each, np.log(rates) + each[:1])
        if used is not None and known is not None:
            told[:, :, np.diag(known) > _TOLD * np.diag(used.covariance)] = 0.0
        self._steps.append(told)


def _log_density(off: FloatArray, changes: FloatArray, variances: FloatArray) -> FloatArray:
    """Of deviations by Student's t of these squared scales, widened by normal errors, less the normal's constant."""
    scales = changes + _NORMAL * variances
    return _AT_ZERO - 0.5 * (_FREEDOM + 1.0) * np.log1p(off**2 / (_FREEDOM * scales)) - 0.5 * np.log(scales)
