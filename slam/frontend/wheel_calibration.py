"""What a run learns about the wheels on its way: the errors of calibration, which stay the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from slam.frontend.information import positive
from slam.frontend.odometry import Motion, difference, planar_delta, spatial_covariance
from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS
from spplanes._check import FloatArray


class WheelCalibration:
    """Scale and curvature of the odometry, estimated from the motions of the estimate.

    With the calibration c of covariance C, G the response of a motion to it, Q the covariance of the predicted motion
    and P that of the motion after everything was seen, the motion's correction i teaches C G^T Q^-1 i, and C shrinks
    by C G^T Q^-1 (Q - P) Q^-1 G C: nothing when nothing was seen (P = Q).

    Every motion is as wide by itself as its errors of calibration make it, though they are the same in all: for a step
    that is right, over a way it is too little. Once the graph was asked (`CalibrationByGraph`) they are `shared`.
    """

    def __init__(self) -> None:
        self.mean = np.zeros(2)
        self.covariance: FloatArray | None = None
        self.shared = False

    def share(self, mean: FloatArray, covariance: FloatArray) -> None:
        """From now on all motions have this mean, and none is wider for what is open about it: covariances hold it."""
        self.mean, self.covariance, self.shared = mean, covariance, True

    def predict(self, motion: Motion) -> Motion:
        """The motion corrected by what is known of the wheels; as it is while no such errors are stated nor found."""
        if motion.response is None or self.shared or not np.any(motion.calibration_sigmas):
            return self.corrected(motion)
        initial = unknown_at_first(motion)
        if self.covariance is None:
            self.covariance = initial
        way = float(np.linalg.norm(motion.response[:2, 0]))
        # over 500 m wheels are taken to change by as much as was unknown of them at first
        self.covariance = self.covariance + initial * way / 500.0
        most = np.diag(initial) / np.maximum(np.diag(self.covariance), np.finfo(float).tiny)
        self.covariance *= np.sqrt(np.outer(*(2 * [np.minimum(1.0, most)])))
        return self.corrected(motion)

    def corrected(self, motion: Motion) -> Motion:
        """A motion as measured, by what is known of the wheels; as wide as they may be off while that is its own."""
        if motion.response is None or self.covariance is None:
            return motion
        turned, shifted = np.eye(4), motion.a_T_b.copy()
        x, y, heading = (motion.response @ self.mean).tolist()
        turned[:2, :2] = ((np.cos(heading), -np.sin(heading)), (np.sin(heading), np.cos(heading)))
        shifted[:3, :3] = turned[:3, :3] @ shifted[:3, :3]
        shifted[:2, 3] += x, y
        covariance = random_covariance(motion)
        if not self.shared:
            covariance = covariance + shared_covariance(motion, self.covariance)
        return replace(motion, a_T_b=shifted, covariance=covariance)

    def learn(self, predicted: Motion, a_T_b: FloatArray, covariance: FloatArray) -> None:
        """Take in what became of a motion that `predict` gave: a_T_b (4, 4) by the estimate.

        The covariance is that of its (x, y, theta), shape (3, 3), in the axes of a.
        """
        if self.covariance is None or self.shared or predicted.response is None or not predicted.is_planar:
            return
        correction = difference(planar_delta(a_T_b), planar_delta(predicted.a_T_b))
        told = np.linalg.solve(predicted.covariance, correction)
        gained = predicted.covariance - covariance
        if correction @ told > chdtri(3, 1e-2) or np.linalg.eigvalsh(gained)[-1] <= 0.0:
            return  # something else is wrong, or nothing was seen
        gain = self.covariance @ np.linalg.solve(predicted.covariance, response_as_moved(predicted, a_T_b)).T
        self.mean = self.mean + gain @ correction
        self.covariance = self.covariance - gain @ positive(gained) @ gain.T


def response_as_moved(motion: Motion, a_T_b: FloatArray) -> FloatArray:
    """The response of a motion, (3, 2), by how far the body moved, a_T_b (4, 4): for a scale that is the way itself.

    As measured the way has the noise that the scale is to explain. Taken for it, n steps whose way across, say, is told
    and none along pull the scale towards -1 by as much as n measurements of it, each with a sigma of 1: they are
    explained as soon as nothing counts.
    """
    assert motion.response is not None
    response = motion.response.copy()
    response[:2, 0] = a_T_b[:2, 3]
    return response


def unknown_at_first(motion: Motion) -> FloatArray:
    """Covariance (2, 2) of scale and curvature before anything was seen: as stated, or of wheels nobody describes."""
    stated = motion.calibration_sigmas
    return np.diag(np.square(stated if np.any(stated) else UNCALIBRATED_WHEELS.calibration_sigmas))


def shared_covariance(motion: Motion, covariance: FloatArray) -> FloatArray:
    """What errors of calibration of a covariance (2, 2) do to a motion, in the order of the motion's own covariance."""
    assert motion.response is not None
    planar = motion.response @ covariance @ motion.response.T
    return planar if motion.is_planar else spatial_covariance(planar, motion.a_T_b, (0.0, 0.0, 0.0))


def random_covariance(motion: Motion) -> FloatArray:
    """The part of a motion's covariance that is of no other motion: without the stated errors of calibration."""
    return motion.covariance - shared_covariance(motion, np.diag(np.square(motion.calibration_sigmas)))
