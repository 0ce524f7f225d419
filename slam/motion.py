"""The noise model of wheel odometry: drift per metre and per radian, and the covariance of a relative motion."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field

from spplanes._check import FloatArray, as_shape

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class OdometryNoise(BaseModel):
    """Random walk of wheel odometry: variances grow with the way driven and the angle turned.

    Because variances (not standard deviations) are proportional to the motion, one relative motion over two steps has
    the same covariance as the two steps composed: the model does not depend on how often odometry is read.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    along_sigma_m_per_sqrt_m: NotNegative = 0.02
    """Standard deviation along the motion after 1 m, m."""
    lateral_sigma_m_per_sqrt_m: NotNegative = 0.01
    """Standard deviation across the motion after 1 m, m; what the heading error adds comes on top of it."""
    heading_sigma_rad_per_sqrt_m: NotNegative = 0.0087
    """Standard deviation of the heading after 1 m (0.5 deg), rad."""
    heading_sigma_rad_per_sqrt_rad: NotNegative = 0.02
    """Standard deviation of the heading after a turn of 1 rad, rad."""
    floor_m: Positive = 1e-4
    """Standard deviation that even a motion of nothing has, m; keeps the covariance invertible."""
    floor_rad: Positive = 1e-5
    """The same of the heading, rad."""
    z_sigma_m: Positive = 1e-3
    """Out of plane: standard deviation of the height between two keyframes, m."""
    pitch_sigma_rad: Positive = 1e-3
    """Out of plane: standard deviation of the rotation about y (theta) between two keyframes, rad."""
    roll_sigma_rad: Positive = 1e-3
    """Out of plane: standard deviation of the rotation about x (psi) between two keyframes, rad."""

    def covariance(self, delta: ArrayLike) -> FloatArray:
        """Covariance of a relative motion `delta` (x, y, theta), shape (3, 3), m^2, m rad, rad^2.

        The error is additive on (x, y, theta), with x and y in the frame of the first pose. The turn is taken as
        spread evenly over a straight way, so a heading variance q over a way L leaves q L^2 / 3 across it and q L / 2
        in the cross term.
        """
        dx, dy, dtheta = as_shape("delta", delta, (3,))
        way, turn = float(np.hypot(dx, dy)), abs(float(dtheta))
        heading = self.heading_sigma_rad_per_sqrt_m**2 * way + self.heading_sigma_rad_per_sqrt_rad**2 * turn
        covariance = np.diag([self.floor_m**2, self.floor_m**2, self.floor_rad**2 + heading])
        if way == 0.0:
            return covariance
        along = np.array([dx, dy]) / way
        across = np.array([-along[1], along[0]])
        lateral = self.lateral_sigma_m_per_sqrt_m**2 * way + heading * way**2 / 3.0
        covariance[:2, :2] += self.along_sigma_m_per_sqrt_m**2 * way * np.outer(along, along)
        covariance[:2, :2] += lateral * np.outer(across, across)
        covariance[:2, 2] = covariance[2, :2] = heading * way / 2.0 * across
        return covariance

    def accumulate(self, deltas: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Compose motions (K, 3) one after another: the whole motion (3,) and its covariance (3, 3), first order."""
        total, covariance = np.zeros(3), np.zeros((3, 3))
        for delta in as_shape("deltas", deltas, (None, 3)):
            c, s = np.cos(total[2]), np.sin(total[2])
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            moved = turn @ delta
            carry = np.eye(3)
            carry[:2, 2] = -moved[1], moved[0]
            covariance = carry @ covariance @ carry.T + turn @ self.covariance(delta) @ turn.T
            total = total + moved
        return total, covariance
