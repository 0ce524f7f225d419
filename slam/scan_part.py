"""A region of a 3D scan: its points with all that the sensor errs in, and the plane that they are believed to be."""

from __future__ import annotations

import numpy as np

from slam.config import MeasurementConfig
from slam.goodness import InPatches, could_be_seen, fits_its_noise
from slam.point_errors import servo_covariances, surface_covariances, tilt_drift
from slam.rig import Sensor
from spplanes import Plane, fit_plane
from spplanes._check import FloatArray

#: So often a plane is fitted anew without what strays from it, and so much of its points must be left.
_ROUNDS, _LEAST_SHARE = 4, 0.9


class ScanPart:
    """Points of a region of a 3D scan, with all that the sensor errs in."""

    def __init__(
        self, grid: FloatArray, covariances: FloatArray, members: np.ndarray, frame: FloatArray, sensor: Sensor
    ) -> None:
        """Points `members` of a flat grid (S, B, 3) with covariances (S, B, 3, 3) about a plane of frame (4, 4)."""
        self._source = grid, covariances, frame, sensor
        self.members, self.sensor = members, sensor
        self.points = grid.reshape(-1, 3)[members]
        self.noise = surface_covariances(self.points, covariances.reshape(-1, 3, 3)[members], frame, sensor)
        self.blurred = servo_covariances(self.points, self.noise, members // grid.shape[1], sensor)

    def drift(self, plane: Plane) -> FloatArray | None:
        """What the servo's slow error shifts every point by, (N,), m; None: there is none."""
        return tilt_drift(plane, self.points, self.sensor) if self.sensor.tilt_sigma_rad > 0.0 else None

    def only(self, chosen: np.ndarray) -> ScanPart:
        """The points of a mask (N,)."""
        grid, covariances, frame, sensor = self._source
        return ScanPart(grid, covariances, self.members[chosen], frame, sensor)


def believed_plane(
    part: ScanPart, plane: Plane, viewpoint: FloatArray, rules: MeasurementConfig
) -> tuple[Plane, np.ndarray] | None:
    """The plane of a region, if it is one, and which members of the region are not on it; None: it is none.

    A plane is fitted anew without the patches that stray, which moves it and its patches: so a few times over.
    """
    rest = part
    for _ in range(_ROUNDS):
        patches = InPatches(plane, rest.points, rest.noise, rules, drift_m=rest.drift(plane))
        if could_be_seen(plane, viewpoint, rules) and fits_its_noise(plane, rules) and not patches.has_step:
            return plane, np.setdiff1d(part.members, rest.members, assume_unique=True)
        chosen = patches.without_strays()
        if chosen is None or np.count_nonzero(chosen) < _LEAST_SHARE * len(part.members):
            return None
        rest = rest.only(chosen)
        again = fit_if_any(rest.points, rest.blurred, viewpoint=viewpoint)
        if again is None:
            return None
        plane = again
    return None


def fit_if_any(points: FloatArray, covariances: FloatArray, **fit: np.ndarray) -> Plane | None:
    """The plane of points, or None where they do not determine one: one bad patch must not end a run."""
    try:
        return fit_plane(points, covariances, **fit)  # type: ignore[arg-type]
    except ValueError:
        return None
