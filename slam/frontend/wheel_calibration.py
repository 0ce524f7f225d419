"""What a run learns about the wheels on its way: the errors of calibration, which stay the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from slam.frontend.odometry import Motion, difference, planar_delta
from spplanes._check import FloatArray

#: A motion further from its prediction than this probability allows teaches nothing: something else is wrong.
_SIGNIFICANCE = 1e-2
#: Way over which wheels are taken to change by as much as was unknown of them at first, m.
_MEMORY_M = 500.0


class WheelCalibration:
    """Scale and curvature of the odometry, estimated from the motions of the estimate.

    With the calibration c of covariance C, G the response of a motion to it, Q the covariance of the predicted motion
    and P that of the motion after everything was seen, the motion's correction i teaches C G^T Q^-1 i, and C shrinks
    by C G^T Q^-1 (Q - P) Q^-1 G C: nothing when nothing was seen (P = Q).
    """

    def __init__(self) -> None:
        self.mean = np.zeros(2)
        self.covariance: FloatArray | None = None
        self._initial = np.zeros((2, 2))

    def predict(self, motion: Motion) -> Motion:
        """The motion corrected by what is known of the wheels; as it is when its noise model states no such errors."""
        if motion.response is None or not np.any(motion.calibration_sigmas):
            return motion
        if self.covariance is None:
            self._initial = np.diag(np.square(motion.calibration_sigmas))
            self.covariance = self._initial.copy()
        way = float(np.linalg.norm(motion.response[:2, 0]))
        self.covariance = self.covariance + self._initial * way / _MEMORY_M
        self.covariance *= np.sqrt(
            np.outer(*(2 * [np.minimum(1.0, np.diag(self._initial) / np.diag(self.covariance))]))
        )
        return self.corrected(motion)

    def corrected(self, motion: Motion) -> Motion:
        """A motion as measured, by what is known of the wheels now."""
        if motion.response is None or self.covariance is None:
            return motion
        unknown = self.covariance - self._initial
        delta = planar_delta(motion.a_T_b) + motion.response @ self.mean
        covariance = motion.covariance + motion.response @ unknown @ motion.response.T
        return replace(motion, a_T_b=_transform(delta), covariance=covariance)

    def learn(self, predicted: Motion, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Take in what became of a predicted motion.

        Args:
            predicted: As `predict` gave it.
            a_T_b: The motion by the estimate, shape (4, 4).
            covariance: Of its (x, y, theta), shape (3, 3), in the axes of a.
        """
        if self.covariance is None or predicted.response is None:
            return
        correction = difference(planar_delta(a_T_b), planar_delta(predicted.a_T_b))
        told = np.linalg.solve(predicted.covariance, correction)
        gained = predicted.covariance - covariance
        if correction @ told > chdtri(3, _SIGNIFICANCE) or np.linalg.eigvalsh(gained)[-1] <= 0.0:
            return
        gain = self.covariance @ np.linalg.solve(predicted.covariance, predicted.response).T
        self.mean = self.mean + gain @ correction
        self.covariance = self.covariance - gain @ _positive(gained) @ gain.T


def _positive(matrix: FloatArray) -> FloatArray:
    """The nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def _transform(delta: FloatArray) -> FloatArray:
    x, y, theta = delta.tolist()
    a_T_b = np.eye(4)
    a_T_b[:2, :2] = ((np.cos(theta), -np.sin(theta)), (np.sin(theta), np.cos(theta)))
    a_T_b[:2, 3] = x, y
    return a_T_b
