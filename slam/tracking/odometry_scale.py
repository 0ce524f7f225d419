"""By how much more than stated odometry errs at every step, and how steadily the body moves, learnt from the drive."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from slam.frontend.odometry import Motion, spatial_covariance
from spplanes._check import FloatArray

#: Steps that say how the odometry is of late: wheels that slip on one floor hold on the next.
LATE = 60
#: Factors on the stated sigma that are told apart, and how likely each is before any step is seen: a rig is as likely
#: right as not, and an odometry that errs by ten times as much is a guess at best.
_FACTORS = np.geomspace(1.0, 10.0, 25)
_PRIOR = np.log(np.append(0.5, np.full(24, 0.5 / 24)))
#: Shares that are told apart of how far a body may move of which nothing is known, before any step is seen all of it.
_SHARES = np.geomspace(1.0, 0.03, 25)
#: Share of steps that tell nothing of the others, before any is seen: a slip, or a scan that came to rest elsewhere.
SLIPS = 0.1
#: Of (x, y, heading) in SP order.
PLANAR = [0, 1, 3]


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
        return _mean(_FACTORS, self._steps)

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
        stated = np.array([spatial(scaled(motion, factor))[grid] for factor in _FACTORS])
        honest = log_density(off[axes], stated + covariance[grid])
        slipped = log_density(off[axes], (spatial(guess) + covariance)[grid][None])
        both = np.stack((np.log1p(-SLIPS) + honest, np.full_like(honest, np.log(SLIPS) + slipped[0])))
        self._steps.append(np.logaddexp(*both))


class VelocityPrior:
    """How far a body is from where it would be by constant velocity, by its last steps.

    Robots drive on as they did, or turn: a motion that nobody measured is, as likely as not, as near to the one before
    as the last were to those before them; else it may be any.
    """

    def __init__(self) -> None:
        self._steps: deque[FloatArray] = deque(maxlen=LATE)

    def learn(self, off: FloatArray, guess: Motion) -> None:
        """Take in a step that was so far off the one before, SP order, (6,); `guess`: as of `log_density`."""
        covariance = spatial(guess)[np.ix_(PLANAR, PLANAR)]
        self._steps.append(log_density(off[PLANAR], _SHARES[:, None, None] ** 2 * covariance))

    def log_density(self, off: FloatArray, guess: Motion, place: FloatArray, axes: Sequence[int]) -> float:
        """Of a motion that nobody measured, along some axes, up to the constant of the function of that name.

        Args:
            off: from where it leads by constant velocity, SP order along the axes there, shape (6,).
            guess: how far a body may move of which nothing is known.
            place: covariance of where the body was found, SP order, shape (6, 6).
            axes: which of the six are asked for.
        """
        covariances = np.array([share**2 * spatial(guess) + place for share in (_mean(_SHARES, self._steps), 1.0)])
        return float(logsumexp(log_density(off[axes], covariances[:, axes][:, :, axes])) - np.log(2.0))


def _mean(factors: FloatArray, steps: Collection[FloatArray]) -> float:
    """Posterior mean, of the logarithm, of a factor by the log-likelihoods that steps say; 1 without any."""
    if not steps:
        return 1.0
    posterior = _PRIOR + np.sum(list(steps), axis=0)
    return float(np.exp(np.exp(posterior - logsumexp(posterior)) @ np.log(factors)))


def free_axes(motion: Motion) -> list[int]:
    """Those along which a motion says anything, SP order: (x, y, heading) of one on a floor."""
    return PLANAR if motion.is_planar else list(range(6))


def scaled(motion: Motion, factor: float) -> Motion:
    """A motion of so many times the sigma."""
    return motion if factor == 1.0 else replace(motion, covariance=factor**2 * motion.covariance)


def spatial(motion: Motion) -> FloatArray:
    """Covariance of a motion in SP order along the axes of its end, shape (6, 6)."""
    if not motion.is_planar:
        return motion.covariance
    return spatial_covariance(motion.covariance, motion.a_T_b, motion.out_of_plane_sigmas)


def log_density(off: FloatArray, covariances: FloatArray) -> FloatArray:
    """Logarithm of normal densities of one deviation (D,), covariances (K, D, D), up to one constant, shape (K,)."""
    chi2 = np.einsum("i,kij,j->k", off, np.linalg.inv(covariances), off)
    return -0.5 * (chi2 + np.linalg.slogdet(covariances)[1])
