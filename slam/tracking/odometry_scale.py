"""By how much more than stated odometry errs at every step, learnt from the drive."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from slam.frontend.odometry import PLANAR_IN_SP, Motion
from slam.frontend.steadiness import HALF_AT_ONE, LATE
from spplanes._check import FloatArray

#: Factors on the stated sigma that are told apart: a rig is as likely right as not, and an odometry that errs by ten
#: times as much is a guess at best.
_FACTORS = np.geomspace(1.0, 10.0, 25)
#: Share of steps that tell nothing of the others, before any is seen: a slip, or a scan that came to rest elsewhere.
SLIPS = 0.1


class OdometryScale:
    """Factor on the odometry's sigma, by the errors of its last steps.

    A step off by e, seen with covariance P, has e ~ N(0, s^2 C + P) where the odometry states C, or is one of which
    nothing is known.
    """

    def __init__(self) -> None:
        self._steps: deque[FloatArray] = deque(maxlen=LATE)

    @property
    def factor(self) -> float:
        """Times the stated sigma, 1 or more: the posterior mean, of the logarithm; 1 where no step was seen."""
        if not self._steps:
            return 1.0
        posterior = HALF_AT_ONE + np.sum(list(self._steps), axis=0)
        return float(np.exp(np.exp(posterior - logsumexp(posterior)) @ np.log(_FACTORS)))

    def learn(self, motion: Motion, off: FloatArray, covariance: FloatArray, guess: Motion) -> None:
        """Take in a step.

        Args:
            motion: as it was measured, with the covariance that is stated.
            off: where the body turned out to be from where the motion leads, SP order along the axes there, shape (6,).
            covariance: of that, shape (6, 6).
            guess: how far a body may move of which nothing is known.
        """
        axes = free_axes(motion)
        grid = np.ix_(axes, axes)
        stated = np.array([scaled(motion, factor).spatial[grid] for factor in _FACTORS])
        honest = _log_density(off[axes], stated + covariance[grid])
        slipped = _log_density(off[axes], (guess.spatial + covariance)[grid][None])
        both = np.stack((np.log1p(-SLIPS) + honest, np.full_like(honest, np.log(SLIPS) + slipped[0])))
        self._steps.append(np.logaddexp(*both))


def free_axes(motion: Motion) -> list[int]:
    """Those along which a motion says anything, SP order: (x, y, heading) of one on a floor."""
    return list(PLANAR_IN_SP) if motion.is_planar else list(range(6))


def scaled(motion: Motion, factor: float) -> Motion:
    """A motion of so many times the sigma."""
    return motion if factor == 1.0 else replace(motion, covariance=factor**2 * motion.covariance)


def _log_density(off: FloatArray, covariances: FloatArray) -> FloatArray:
    """Logarithm of normal densities of one deviation (D,), covariances (K, D, D), up to one constant, shape (K,)."""
    chi2 = np.einsum("i,kij,j->k", off, np.linalg.inv(covariances), off)
    return -0.5 * (chi2 + np.linalg.slogdet(covariances)[1])
