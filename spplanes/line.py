"""The value type of a line seen by a 2D laser."""

from __future__ import annotations

from dataclasses import dataclass
from math import atan2, cos, hypot, isfinite, nan, pi, remainder, sin
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import (
    TOO_LARGE,
    FloatArray,
    as_covariance,
    as_number,
    as_shape,
    as_transform,
    check_instance,
    read_only,
)
from spplanes.spmodel import chi2_of


@dataclass(frozen=True, eq=False)
class ScanLine:
    """A straight segment seen in one 2D scan, in the sensor's scan plane (x forward, y left, z = 0).

    Parameterisation: x cos(alpha) + y sin(alpha) = rho with rho >= 0. The covariance is that of (alpha, rho), additive.
    A value: its arrays are read-only.

    The same line in the SPmodel is `sp_frame` and `sp_covariance`: a line is the x axis of its frame, whose origin is
    the point of the line where shift and rotation are uncorrelated and whose y axis points to the sensor. The symmetry
    is the shift along x; the perturbation is p = (y, phi), shift along y and rotation about z, composed on the right.
    To first order the perturbed line is y(x) = p_y + phi x.

    References:
        Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, section II (SPmodel).
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
    """Indices of the beams that support the line, shape (N,), int64, in beam order (increasing bearing)."""
    chi2: float = nan
    """Sum of the squared normalised range residuals of the fitted beams; NaN when it was not computed."""
    dof: int = 0
    """Degrees of freedom of `chi2`: the fitted beams less 2. Beams that may be of the next wall are not fitted."""

    def __post_init__(self) -> None:
        alpha, rho = as_number("alpha", self.alpha, finite=False), as_number("rho", self.rho, finite=False)
        if not isfinite(alpha):
            raise ValueError(f"alpha: expected a finite angle, got {alpha}")
        if not 0.0 <= rho < TOO_LARGE:
            raise ValueError(f"rho: expected a finite distance >= 0, got {rho}")
        object.__setattr__(self, "alpha", alpha if -pi < alpha <= pi else wrap_angle(alpha))
        object.__setattr__(self, "rho", rho)
        indices = np.asarray(self.indices)
        if indices.ndim != 1 or (indices.dtype.kind not in "iu" and indices.size):
            raise ValueError(f"indices: expected integers of shape (N,), got {indices.dtype} of shape {indices.shape}")
        object.__setattr__(self, "indices", read_only(indices.astype(np.int64)))
        object.__setattr__(self, "endpoints", read_only(as_shape("endpoints", self.endpoints, (2, 2)).copy()))
        object.__setattr__(self, "covariance", read_only(as_covariance("covariance", self.covariance, 2)))

    @classmethod
    def _trusted(cls, *values: Any) -> Self:
        """A line from the values of its fields, in order, that are known to be good, without checking them again."""
        line = object.__new__(cls)
        for name, value in zip(cls.__match_args__, values, strict=True):
            line.__dict__[name] = read_only(value) if isinstance(value, np.ndarray) else value
        return line

    @property
    def normal(self) -> FloatArray:
        """Unit normal (cos alpha, sin alpha), shape (2,); it points from the sensor to the line."""
        return np.array((cos(self.alpha), sin(self.alpha)))

    @property
    def direction(self) -> FloatArray:
        """Unit vector along the line in the sense of increasing bearing, shape (2,)."""
        return np.array((-sin(self.alpha), cos(self.alpha)))

    @property
    def length(self) -> float:
        """Distance between the end points, m."""
        (x0, y0), (x1, y1) = self.endpoints.tolist()
        return hypot(x1 - x0, y1 - y0)

    @property
    def sp_frame(self) -> FloatArray:
        """sensor_T_line, shape (4, 4): x along the line, y to the sensor, origin where y and phi are uncorrelated."""
        v_alpha, cov = self.covariance[0].tolist()
        along = cov / v_alpha if v_alpha > 0.0 else float(self.endpoints.mean(axis=0) @ self.direction)
        frame = np.eye(4)
        frame[:2, 0], frame[:2, 1] = self.direction, -self.normal
        frame[:2, 3] = self.rho * self.normal + along * self.direction
        return frame

    @property
    def sp_covariance(self) -> FloatArray:
        """Covariance of the SP perturbation (y, phi), shape (2, 2), m^2, m rad, rad^2."""
        return self.covariance_at(float(self.sp_frame[:2, 3] @ self.direction))

    def covariance_at(self, along: float) -> FloatArray:
        """Covariance of (shift toward the sensor, turn) of the line at a place on it, shape (2, 2), m^2, m rad, rad^2.

        A change (d_alpha, d_rho) turns the line by d_alpha, and moves it by d_rho - along d_alpha away from the sensor
        at the place that is ``along`` m in its direction from the foot of its normal.
        """
        jacobian = np.array(((along, -1.0), (1.0, 0.0)))
        return jacobian @ self.covariance @ jacobian.T

    def transform(self, T: ArrayLike, covariance: ArrayLike | None = None) -> ScanLine:
        """Return the line in another frame.

        Args:
            T: target_T_sensor, shape (4, 4), a motion in the scan plane.
            covariance: of the pose (x, y, theta) of T, additive, shape (3, 3); independent of the line's own.

        Raises:
            ValueError: T is no rigid transform, or leaves the scan plane.
        """
        T = as_transform("T", T)
        if abs(T[2, 2] - 1.0) > 1e-9 or abs(T[2, 3]) > 1e-9:
            raise ValueError("T: expected a motion in the scan plane (rotation about z, no shift along z)")
        x, y = float(T[0, 3]), float(T[1, 3])
        alpha = self.alpha + atan2(T[1, 0], T[0, 0])
        c, s = cos(alpha), sin(alpha)
        rho, lever = self.rho + x * c + y * s, y * c - x * s
        sign = 1.0 if rho >= 0.0 else -1.0
        by_line = np.array(((1.0, 0.0), (sign * lever, sign)))
        result = by_line @ self.covariance @ by_line.T
        if covariance is not None:
            by_pose = np.array(((0.0, 0.0, 1.0), (sign * c, sign * s, sign * lever)))
            result += by_pose @ as_covariance("covariance", covariance, 3) @ by_pose.T
        alpha = wrap_angle(alpha if sign > 0.0 else alpha + pi)
        endpoints = self.endpoints @ T[:2, :2].T + T[:2, 3]
        return ScanLine(alpha, sign * rho, result, endpoints, self.indices, self.chi2, self.dof)

    def mahalanobis(self, other: ScanLine) -> float:
        """Chi2 with 2 dof that both are one infinite line, their errors independent.

        (alpha, rho) and (alpha + pi, -rho) are the same line: the smaller of both readings counts.
        """
        check_instance("other", other, ScanLine)
        turn = remainder(other.alpha - self.alpha, 2.0 * pi)
        chi2 = chi2_of(np.array((turn, other.rho - self.rho)), self.covariance + other.covariance)
        off = np.array((remainder(turn + pi, 2.0 * pi), -other.rho - self.rho))
        flip = np.array(((1.0, -1.0), (-1.0, 1.0)))
        return min(chi2, chi2_of(off, self.covariance + flip * other.covariance))


def wrap_angle(angle: float) -> float:
    """The same angle in (-pi, pi]."""
    wrapped = remainder(angle, 2.0 * pi)
    return pi if wrapped == -pi else wrapped
