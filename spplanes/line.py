"""The value type of a line seen by a 2D laser."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class ScanLine:
    """A straight segment seen in one 2D scan, in the sensor's scan plane (x forward, y left, z = 0).

    Parameterisation: x cos(alpha) + y sin(alpha) = rho with rho >= 0. The covariance is that of (alpha, rho).
    """

    alpha: float
    """Direction of the normal, rad, in (-pi, pi]; it points from the sensor to the line."""
    rho: float
    """Distance of the infinite line from the sensor, m, >= 0."""
    covariance: FloatArray
    """Covariance of (alpha, rho), shape (2, 2), rad^2, rad m, m^2."""
    endpoints: FloatArray
    """First and last point of the segment, on the line, in beam order, shape (2, 2), m."""
    indices: np.ndarray
    """Indices of the beams that support the line, shape (N,), int64, in beam order."""
