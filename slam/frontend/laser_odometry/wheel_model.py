"""Odometry of unknown quality: the scale of its noise along, across and in heading, learnt from matched scans."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray

#: Degrees of freedom of a step's Student t distribution, per axis.
_TAIL = 4.0
#: Steps that the stated noise is worth before anything is seen, and over which what was learnt is forgotten.
_STATED, _MEMORY = 4.0, 150.0


class NoiseScale:
    """Factors on the variances of odometry's steps along, across and in heading: an inverse gamma of each.

    One step of expectation maximisation a step: with P the variance of the step before its end was seen, P' after, and
    e the correction, the wheels' squared error is expected to be e^2 + P'. The step counts by its share 1 - P' / P:
    what the returns leave open teaches nothing. A step that a Student t calls an outlier counts less.
    """

    def __init__(self) -> None:
        self._shape, self._rate = np.full(3, _STATED), np.full(3, _STATED)

    @property
    def factors(self) -> FloatArray:
        """On the variances, shape (3,)."""
        return self._rate / self._shape

    def scaled(self, covariance: FloatArray) -> FloatArray:
        """A stated covariance (3, 3) of (x, y, theta), x along the motion, as the drive has shown it to be."""
        roots = np.sqrt(self.factors)
        return covariance * np.outer(roots, roots)

    def learn(self, error: FloatArray, stated: FloatArray, posterior: FloatArray, predicted: FloatArray) -> None:
        """Take in one step.

        Args:
            error: The step by wheels and returns together less that by the wheels, (x, y, theta), shape (3,).
            stated: Covariance of the wheels' random error as the rig states it, shape (3, 3).
            posterior, predicted: Covariance of the step after and before its end was seen, shape (3, 3).
        """
        stated_variance, before, after = np.diag(stated), np.diag(predicted), np.diag(posterior)
        gain = np.clip(1.0 - after / before, 0.0, 1.0)
        squared = error**2 + after
        weight = (_TAIL + 1.0) / (_TAIL + squared / before)
        kept = 1.0 - gain / _MEMORY
        self._shape = kept * self._shape + gain
        self._rate = kept * self._rate + gain * weight * squared / stated_variance
