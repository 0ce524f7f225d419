"""Scan noise: what the points of a plane err in, each beam by itself, patches and servo lines alike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.sensors.log import LaserScan
from slam.sensors.rig import Sensor
from spplanes import Plane
from spplanes._check import FloatArray
from spplanes.lines.extraction import LineConfig, beam_noise
from spplanes.noise import SensorModel
from spplanes.segmentation.validation.one_plane import numbered, patches_of

#: How far beams of a 2D laser scatter where nothing is known of it, m: the data sheet of a SICK LMS 200. Lines are
#: looked for by no less: where beams scatter by less, they are found as well.
TYPICAL_BEAM_SIGMA_M = 0.015


def model_of(sensor: Sensor) -> SensorModel:
    """Errors of the sensor's beams."""
    return SensorModel(
        range_sigma_m=sensor.range_sigma_m,
        range_sigma_per_m2=float(np.hypot(sensor.disparity_sigma_per_m, sensor.disparity_step_per_m / np.sqrt(12.0))),
        bearing_sigma_rad=sensor.bearing_sigma_rad,
        quantisation_m=sensor.quantisation_m,
    )


def surface_covariances(points: FloatArray, covariances: FloatArray, frame: FloatArray, sensor: Sensor) -> FloatArray:
    """Covariances (N, 3, 3) of the points of a plane, frame (4, 4), that carry the surface's own error as well.

    The surface is cut into square patches of the correlation length; the points of one patch share an error of
    `surface_sigma_m` along the normal. n points that share it say as much as n points with n times its variance each,
    so a patch seen by many beams counts no more than its surface allows.
    """
    if sensor.surface_sigma_m == 0.0:
        return covariances
    row, column, n_rows, n_columns = patches_of(points, frame, sensor.surface_correlation_m)
    patch, _ = numbered(row * n_columns + column, n_rows * n_columns)
    return _with_shared(covariances, patch, frame[None, :3, 2], sensor.surface_sigma_m**2)


def shown_by_lines(sensor: Sensor, scans: Sequence[object]) -> float | None:
    """How far the beams of a 2D laser scatter about the lines of its scans, m; None where too few are on any.

    What is stated only says by how much to look for lines: surfaces that are uneven over less than a patch of a line,
    steps of ranges and noise are all in what is found.
    """
    lasers = [scan for scan in scans if isinstance(scan, LaserScan)]
    asked = [lasers[index] for index in np.unique(np.linspace(0, len(lasers) - 1, 150).astype(int)) if lasers]
    beams = [(scan.ranges, scan.angles) for scan in asked]
    limits = LineConfig(
        bearing_sigma=sensor.bearing_sigma_rad, range_min=sensor.range_min_m, range_max=sensor.range_max_m
    )
    seen_m, telling = beam_noise(beams, max(sensor.beam_sigma_m, TYPICAL_BEAM_SIGMA_M), limits)
    return seen_m if telling >= 1000 else None  # beams on lines


def with_beam_sigma(sensor: Sensor, seen_m: float) -> Sensor:
    """The sensor with so much noise of its beams that they scatter by `seen_m` about lines, at least half of it."""
    other = sensor.beam_sigma_m**2 - sensor.range_sigma_m**2
    return sensor.model_copy(update={"range_sigma_m": float(np.sqrt(max(seen_m**2 - other, (0.5 * seen_m) ** 2)))})


def line_tilt_covariances(sensor: Sensor, n_lines: int) -> FloatArray | None:
    """Covariances (S, 6, 6) of the errors (x, y, z, phi, theta, psi) of a tilting scanner's lines; None: none."""
    if sensor.tilt_sigma_rad == 0.0:
        return None
    return np.tile(np.diag([0.0, 0.0, 0.0, 0.0, sensor.tilt_sigma_rad**2, 0.0]), (n_lines, 1, 1))


def servo_covariances(points: FloatArray, covariances: FloatArray, line: np.ndarray, sensor: Sensor) -> FloatArray:
    """Covariances (N, 3, 3) of a plane's points (N, 3) that also carry the servo's error, which lines (N,) share.

    The lines are taken in blocks of `tilt_correlation_lines` that err alike, each block on its own. As with surfaces, n
    points that share an error say as much as n points with n times its variance each.
    """
    if sensor.tilt_sigma_rad == 0.0:
        return covariances
    block = (line / sensor.tilt_correlation_lines).astype(np.int64)
    return _with_shared(covariances, block, _lever(points), sensor.tilt_sigma_rad**2)


def _with_shared(covariances: FloatArray, group: np.ndarray, direction: FloatArray, variance: float) -> FloatArray:
    """Covariances (N, 3, 3) with an error along a direction that the points of a group (N,) share; see above.

    Directions are of each point, (N, 3), or one of all, (1, 3); their length scales the error.
    """
    shared = variance * np.bincount(group)[group]
    return covariances + shared[:, None, None] * direction[:, :, None] * direction[:, None, :]


def tilt_drift(plane: Plane, points: FloatArray, sensor: Sensor) -> FloatArray:
    """Standard deviation of the shift along the plane's normal that the servo's error gives points (N, 3), (N,), m."""
    return sensor.tilt_sigma_rad * np.abs(_lever(points) @ plane.normal)


def _lever(points: FloatArray) -> FloatArray:
    """How points (N, 3) move when the servo turns them about y, m per rad, shape (N, 3)."""
    return np.stack((points[:, 2], np.zeros(len(points)), -points[:, 0]), axis=1)
