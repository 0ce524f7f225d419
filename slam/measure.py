"""From raw scans to observations: planes of a 3D scan or a push-broom window, lines of a 2D scan."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.frames import inverse
from slam.io.log import CloudScan, LaserScan
from slam.observations import LineObservation, PlaneObservation
from slam.odometry import OdometryTrack
from slam.outlines import flatten
from slam.rig import Sensor
from slam.window import window_poses
from spplanes import LineConfig, MapperConfig, Plane, extract_lines, fit_plane, segment_scans
from spplanes._check import FloatArray


def planes_of_cloud(scan: CloudScan, sensor: Sensor, config: MapperConfig) -> list[PlaneObservation]:
    """Planes of one 3D scan in the body frame, each facing the sensor, largest first."""
    points = scan.points if scan.points.ndim == 3 else scan.points[None]
    covariances = point_covariances(points, sensor)
    _, planes = segment_scans(points, covariances, config=for_sensor(config, sensor), viewpoints=np.zeros(3))
    body_T_sensor = sensor.body_T_sensor
    moved = [plane.transform(body_T_sensor) for plane in planes]
    return [PlaneObservation(plane) for plane in sorted(moved, key=lambda plane: -plane.n_points)]


def planes_of_window(
    scans: Sequence[LaserScan], stamp_ns: int, sensor: Sensor, track: OdometryTrack, config: MapperConfig
) -> list[PlaneObservation]:
    """Planes of a push-broom window in the body frame at `stamp_ns`.

    The scans are placed by odometry. Its error inside the window is shared by all points of a scan and grows along the
    window, so it goes into the fit as one joint covariance of the scan poses, never into the points' own (DESIGN,
    decision 1).
    """
    if len(scans) < 2:
        return []
    kf_T_body, pose_covariance = window_poses([scan.stamp_ns for scan in scans], stamp_ns, track)
    kf_T_sensor = kf_T_body @ sensor.body_T_sensor
    local = np.stack([beam_points(scan) for scan in scans])
    points = np.einsum("sij,sbj->sbi", kf_T_sensor[:, :3, :3], local) + kf_T_sensor[:, None, :3, 3]
    turned = kf_T_sensor[:, None, :3, :3]
    covariances = turned @ point_covariances(local, sensor) @ turned.swapaxes(-1, -2)
    labels, planes = segment_scans(points, covariances, config=config, viewpoints=kf_T_sensor[:, :3, 3])
    observations = []
    for label, plane in enumerate(planes):
        scan_index, beam = np.nonzero(labels == label)
        refitted = fit_plane(
            points[scan_index, beam],
            covariances[scan_index, beam],
            viewpoint=kf_T_sensor[scan_index, :3, 3].mean(axis=0),
            scan_index=scan_index,
            pose_covariances=pose_covariance,
        )
        observations.append(PlaneObservation(_with_outline_of(refitted, plane)))
    return sorted(observations, key=lambda seen: -seen.n_points)


def lines_of_scan(scan: LaserScan, sensor: Sensor, kf_T_body: FloatArray, config: LineConfig) -> list[LineObservation]:
    """Lines of one 2D scan, with the mount as the keyframe's body sees it."""
    sigma = float(np.sqrt(sensor.range_variance_m2 + sensor.surface_sigma_m**2))
    lines = extract_lines(scan.ranges, scan.angles, sigma=sigma, config=config)
    return [LineObservation(line, kf_T_body @ sensor.body_T_sensor) for line in lines]


def beam_points(scan: LaserScan) -> FloatArray:
    """Points of a 2D scan in the sensor frame, shape (B, 3), m; NaN = no return."""
    return (
        np.column_stack(
            (scan.ranges * np.cos(scan.angles), scan.ranges * np.sin(scan.angles), np.zeros(len(scan.ranges)))
        )
        + np.where(np.isnan(scan.ranges), np.nan, 0.0)[:, None]
    )


def for_sensor(config: MapperConfig, sensor: Sensor) -> MapperConfig:
    """The segmentation's settings with the systematic floor of the sensor, where the rig states a larger one."""
    return replace(config, surface_sigma_m=max(config.surface_sigma_m, sensor.surface_sigma_m))


def point_covariances(points: FloatArray, sensor: Sensor) -> FloatArray:
    """Covariances of points (..., 3) in the sensor frame, shape (..., 3, 3), m^2: range along the beam, bearing across.

    No return gets zeros.
    """
    ranges = np.linalg.norm(points, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        beam = points / ranges
    along = beam[..., :, None] * beam[..., None, :]
    across = (ranges[..., None] * sensor.bearing_sigma_rad) ** 2
    covariances = across * np.eye(3) + (sensor.range_variance_m2 - across) * along
    return np.where(np.isfinite(covariances), covariances, 0.0)


def _with_outline_of(plane: Plane, outlined: Plane) -> Plane:
    """The plane with another's outline, seen along the normal, in its own (x, y)."""
    if outlined.outline is None:
        return plane
    outline = flatten(outlined.outline, inverse(plane.frame) @ outlined.frame)
    return replace(plane, outline=outline)
