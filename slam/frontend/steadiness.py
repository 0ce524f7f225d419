"""How steadily a body keeps its velocity: along each axis as it did of late, or, rarely, as any body may change it.

A robot drives on as it did, or turns; a camera in a hand starts and stops. Acceleration that any of them may have says
little of a step of half a second: most places are within its reach.
"""

from __future__ import annotations

from collections import deque
from math import lgamma, log
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

from spplanes._check import FloatArray

#: Steps that say how the odometry is, and the body moves, of late: wheels that slip on one floor hold on the next.
LATE = 60
#: How likely each of 25 factors is before a step is seen, the first of them 1: as likely that as any other.
HALF_AT_ONE = np.log(np.append(0.5, np.full(24, 0.5 / 24)))
#: Shares that are told apart of how far any body may change its velocity; before a step is seen all of it is likely.
#: The least is that of a robot that drives straight on, 2 cm and 14 mrad in half a second: axes are told by themselves,
#: and six that nothing has ever disturbed outweigh what is seen in the step in which a body turns.
_SHARES = np.geomspace(1.0, 0.01, 25)
#: How often it may change as any body may, not as it usually does: it starts, stops, turns.
_RATES = np.geomspace(0.5, 0.005, 9)
#: Degrees of freedom of the changes, a Student's t: hands are not normal. And its density at 0 against the normal's.
_FREEDOM = 3.0
_AT_ZERO = lgamma(0.5 * _FREEDOM + 0.5) - lgamma(0.5 * _FREEDOM) - 0.5 * log(0.5 * _FREEDOM)


class Usual(NamedTuple):
    """How a body changes its velocity along each of A axes."""

    shares: FloatArray
    """Of the standard deviations of a change that any body may make, how far this one changes it as a rule, (A,)."""
    rates: FloatArray
    """How often it does not keep to that, shape (A,)."""

    def log_densities(self, off: FloatArray, change: FloatArray, known: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Log densities of a usual and of a rare step, weighted, up to the normal's constant, (A,) each.

        Args:
            off: how far off the step is, shape (A,).
            change: variances of a change that any body may make, shape (A,).
            known: of what else makes it differ: the velocity, and how well the step is known, shape (A,).
        """
        usual = np.log1p(-self.rates) + _log_density(off, self.shares**2 * change, known)
        return usual, np.log(self.rates) + _log_density(off, change, known)

    def seen(self, off: FloatArray, change: FloatArray, known: FloatArray) -> Usual:
        """The same of one step, now that it was seen: the rates tell whether it is one of the rare ones."""
        usual, rare = self.log_densities(off, change, known)
        return self._replace(rates=np.exp(rare - np.logaddexp(usual, rare)))

    def less(self, change: FloatArray, least: FloatArray | float = 0.0) -> FloatArray:
        """By how much less than those of any body, `change` (A,), the variances of a change are, shape (A,).

        It is usual or rare, as likely; those of a usual one are not below `least`, (A,).
        """
        usual = np.maximum(_FREEDOM / (_FREEDOM - 2.0) * self.shares**2 * change, least)
        return np.asarray((1.0 - self.rates) * np.maximum(change - usual, 0.0), dtype=np.float64)


class Steadiness:
    """What the last steps of a body say of that, along each of A axes."""

    def __init__(self, axes: int) -> None:
        self._axes = axes
        self._steps: deque[FloatArray] = deque(maxlen=LATE)
        self._known: Usual | None = None  # until the next step

    def usual(self) -> Usual:
        """As far as is known: the mean square of the shares, for of those below the noise of its steps none is told."""
        if self._known is None:
            prior = HALF_AT_ONE[:, None, None] - np.log(len(_RATES))
            posterior = np.broadcast_to(prior, (len(_SHARES), len(_RATES), self._axes)) + sum(self._steps)
            weights = np.exp(posterior - logsumexp(posterior, axis=(0, 1)))
            shares = np.sqrt(np.einsum("sra,s->a", weights, _SHARES**2))
            self._known = Usual(shares, np.einsum("sra,r->a", weights, _RATES))
        return self._known

    def learn(self, off: FloatArray, change: FloatArray, known: FloatArray, told: np.ndarray) -> None:
        """Take in a step, arguments as of `Usual.log_densities`; axes that it does not tell of, mask (A,), are left."""
        each = _log_density(off, _SHARES[:, None] ** 2 * change, known)[:, None]
        rates = _RATES[:, None]
        says = np.logaddexp(np.log1p(-rates) + each, np.log(rates) + each[:1])
        says[:, :, ~told] = 0.0
        self._steps.append(says)
        self._known = None


def _log_density(off: FloatArray, changes: FloatArray, variances: FloatArray) -> FloatArray:
    """Of deviations by Student's t of these squared scales, widened by normal errors, less the normal's constant."""
    scales = changes + 0.63 * variances  # the squared scale of the t that is nearest to a normal distribution
    return _AT_ZERO - 0.5 * (_FREEDOM + 1.0) * np.log1p(off**2 / (_FREEDOM * scales)) - 0.5 * np.log(scales)
