"""Sensor models: what a range, a bearing, a surface and a mount contribute to the covariance of a point."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_float_array, as_shape
from spplanes._jit import njit


@dataclass(frozen=True)
class SensorModel:
    """Errors of a range sensor: of each beam, of each scan, of each surface.

    Errors of a beam are independent and make the points' covariances. Errors of a scan are shared by all its points and
    make a pose covariance. The error of a surface is shared by all points of a plane; averaging removes none of it.
    """

    range_sigma_m: float
    """Standard deviation of a range, m."""
    range_sigma_share: float = 0.0
    """Standard deviation of a range that grows with it, m per m; added in variance."""
    range_sigma_per_m2: float = 0.0
    """Standard deviation of a range that grows with its square, m per m^2; added in variance: depth cameras."""
    bearing_sigma_rad: float = 0.0
    """Standard deviation of the direction of a beam, rad, in both directions across it."""
    quantisation_m: float = 0.0
    """Step of the ranges, m; its variance is step^2 / 12."""
    beam_divergence_rad: float = 0.0
    """Full opening angle of a beam, rad: on a surface seen obliquely the range is that of anywhere in the spot."""
    scan_shift_sigma_m: float = 0.0
    """Standard deviation of a shift that all points of a scan share, along each axis, m: a jerking mount."""
    scan_tilt_sigma_rad: float = 0.0
    """Standard deviation of a turn about each axis that all points of a scan share, rad: the angle of a tilt servo."""
    surface_sigma_m: float = 0.0
    """Flatness of real walls and range bias of real sensors, m; hand it to `MapperConfig.surface_sigma_m`."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                raise ValueError(f"{name}: expected a finite number, 0 or more, got {value}")
        if self.range_sigma_m + self.range_sigma_share + self.range_sigma_per_m2 + self.quantisation_m == 0.0:
            raise ValueError("range_sigma_m: expected some error of the range, got none")

    def range_variance(self, ranges: ArrayLike, incidence_rad: ArrayLike = 0.0) -> FloatArray:
        """Variance of ranges, m^2, of their shape.

        Args:
            ranges: m.
            incidence_rad: angle between beam and surface normal, rad; it only matters with a beam divergence.
        """
        ranges = as_float_array("ranges", ranges)
        spot = ranges * self._spot_share(incidence_rad)
        growing = (self.range_sigma_share * ranges) ** 2 + (self.range_sigma_per_m2 * ranges**2) ** 2
        return self._least_variance + growing + spot**2 / 16.0

    @property
    def _least_variance(self) -> float:
        """Variance of a range on a surface that the beam meets square, however near, m^2."""
        return self.range_sigma_m**2 + self.quantisation_m**2 / 12.0

    def _spot_share(self, incidence_rad: ArrayLike) -> FloatArray:
        """How much the range changes across the spot of a beam, m per m of range."""
        return self.beam_divergence_rad * np.tan(np.minimum(np.abs(incidence_rad), 1.5))

    def covariances(
        self, points: ArrayLike, viewpoints: ArrayLike = (0.0, 0.0, 0.0), incidence_rad: ArrayLike = 0.0
    ) -> FloatArray:
        """Covariances of points from the errors of their beams, shape (..., 3, 3), m^2; NaN where a point is NaN.

        Args:
            points: shape (..., 3), m.
            viewpoints: where each was seen from, broadcast to points, m.
            incidence_rad: angle between beam and surface normal, rad, broadcast to the points.

        Raises:
            ValueError: points of another shape, or a point at its viewpoint: it has no direction.
        """
        points = as_float_array("points", points)
        if points.ndim < 1 or points.shape[-1] != 3:
            raise ValueError(f"points: expected shape (..., 3), got {points.shape}")
        eyes = _one_or_all(as_float_array("viewpoints", viewpoints), points.shape).reshape(-1, 3)
        spot = _one_or_all(np.asarray(self._spot_share(incidence_rad))[..., None], (*points.shape[:-1], 1)).reshape(-1)
        result = np.empty((points.size // 3, 9))
        growing = self.range_sigma_share, self.range_sigma_per_m2, self.bearing_sigma_rad
        known = float(self._least_variance), *(float(one) for one in growing)
        if not _beam_covariances(points.reshape(-1, 3), eyes, spot, known, result):
            raise ValueError("points: expected points away from their viewpoint, got a range of 0")
        return result.reshape(*points.shape, 3)

    def scan_covariance(self) -> FloatArray:
        """Covariance of (x, y, z, phi, theta, psi) that all points of a scan share, about the sensor, shape (6, 6)."""
        return np.diag([self.scan_shift_sigma_m**2] * 3 + [self.scan_tilt_sigma_rad**2] * 3)


@dataclass(frozen=True)
class DepthCameraModel:
    """Axial noise of a structured-light depth camera: sigma_z(z) = base + slope (z - z0)^2.

    The defaults are those of the Kinect.

    References:
        Nguyen, Izadi, Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and Tracking", 2012, eq. 3.
    """

    base_sigma_m: float = 0.0012
    """Standard deviation at the best distance, m."""
    slope_per_m: float = 0.0019
    """Growth with the square of the distance beyond it, 1/m."""
    best_depth_m: float = 0.4
    """The best distance, m."""

    def depth_sigma(self, depth: ArrayLike) -> FloatArray:
        """Standard deviation of depths, m, of their shape."""
        return self.base_sigma_m + self.slope_per_m * (as_float_array("depth", depth) - self.best_depth_m) ** 2

    def covariances(self, points: ArrayLike) -> FloatArray:
        """Covariances of points in the camera frame (z forward), shape (S, B, 3, 3), m^2: along the ray of the pixel.

        Args:
            points: shape (S, B, 3), m; NaN = no depth.
        """
        points = as_shape("points", points, (None, None, 3), finite=False)
        with np.errstate(divide="ignore", invalid="ignore"):
            rays = points / points[..., 2:] * self.depth_sigma(points[..., 2])[..., None]
        return rays[..., :, None] * rays[..., None, :]


def _one_or_all(value: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """A copy of vectors that are broadcast to a shape; of one vector, that alone: all of one type for the kernel."""
    whole = np.broadcast_to(value, shape)
    return np.array(value if value.size == shape[-1] else whole)


@njit(cache=True)
def _beam_covariances(points, eyes, spot, known, result):
    """u u^T var(r) + (I - u u^T) (r sigma_bearing)^2 of every ray, into (N, 9); False where a ray has no length. Of the
    viewpoints (N, 3) and what the range changes across the spot (N,) there may be one for all. `known` are the least
    variance of a range, its growth with the range and with the square of that, and the sigma of bearings."""
    least, share, per_m2, bearing_sigma = known
    for k in range(points.shape[0]):
        e, s = (k if eyes.shape[0] > 1 else 0), (k if spot.shape[0] > 1 else 0)
        ray = points[k, 0] - eyes[e, 0], points[k, 1] - eyes[e, 1], points[k, 2] - eyes[e, 2]
        square = ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2]
        if square == 0.0:
            return False
        ranges = np.sqrt(square)
        across = (ranges * bearing_sigma) ** 2
        growing = (share * ranges) ** 2 + (per_m2 * square) ** 2
        along = (least + growing + (ranges * spot[s]) ** 2 / 16.0 - across) / square
        for a in range(3):
            for b in range(3):
                result[k, 3 * a + b] = along * ray[a] * ray[b]
            result[k, 4 * a] += across
    return True
