"""A 2D laser takes time over a scan, and the robot drives on: every beam from where the body was at its own moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.frontend.odometry import OdometryTrack
from slam.geometry.frames import inverse
from slam.sensors.log import LaserScan
from slam.sensors.rig import Sensor
from slam.sensors.scan_noise import model_of
from spplanes._check import FloatArray
from spplanes.registration import RegisteredScans


def middle_ns(scan: LaserScan, sensor: Sensor) -> int:
    """Time of the middle beam of a scan, whose stamp is that of the first one, ns."""
    return scan.stamp_ns + round(0.5e9 * sensor.sweep_s)


def unswept(scan: LaserScan, sensor: Sensor, track: OdometryTrack) -> LaserScan:
    """The scan as if every beam had been taken at its stamp: returns moved by odometry, within the scan's plane.

    Bearings stay in the order of the beams; a beam without return keeps its own.
    """
    if sensor.sweep_s == 0.0:
        return scan
    points = scan.ranges[:, None] * np.column_stack((np.cos(scan.angles), np.sin(scan.angles), 0.0 * scan.angles))
    mount = sensor.body_T_sensor
    moved = _apply(inverse(mount) @ _since(scan.stamp_ns, scan, sensor, track) @ mount, points)
    hit = np.isfinite(moved).all(axis=1)
    turned = np.where(hit, np.arctan2(moved[:, 1], moved[:, 0]) - scan.angles, 0.0)
    angles = scan.angles + np.remainder(turned + np.pi, 2.0 * np.pi) - np.pi
    ranges = np.where(hit, np.hypot(moved[:, 0], moved[:, 1]), np.nan)
    return LaserScan(scan.stamp_ns, scan.sensor, ranges, np.maximum.accumulate(angles), scan.world_T_body)


def place_beams(
    placed: RegisteredScans, scans: Sequence[LaserScan], kf_T_body: FloatArray, sensor: Sensor, track: OdometryTrack
) -> RegisteredScans:
    """Registered scans (S, B, 3) with every beam where it was.

    They are placed as if each were taken at its middle beam, with the body at `kf_T_body`, shape (S, 4, 4).
    """
    if sensor.sweep_s == 0.0:
        return placed
    points, viewpoints = np.empty_like(placed.points), np.empty_like(placed.points)
    for s, scan in enumerate(scans):
        moved = kf_T_body[s] @ _since(middle_ns(scan, sensor), scan, sensor, track) @ inverse(kf_T_body[s])
        points[s] = _apply(moved, placed.points[s])
        viewpoints[s] = _apply(moved, np.broadcast_to(placed.viewpoints[s], points[s].shape))
    return replace(placed, points=points, covariances=model_of(sensor).covariances(points, viewpoints))


def _since(stamp_ns: int, scan: LaserScan, sensor: Sensor, track: OdometryTrack) -> FloatArray:
    """The body at every beam in its own frame at a time, shape (B, 4, 4)."""
    times = sensor.beam_times_ns(scan.stamp_ns, len(scan.ranges)).tolist()
    poses = track.poses_at([stamp_ns, *times])
    return inverse(poses[0]) @ poses[1:]


def _apply(transforms: FloatArray, points: FloatArray) -> FloatArray:
    """Each point (B, 3) by its own transform (B, 4, 4)."""
    return np.einsum("bij,bj->bi", transforms[:, :3, :3], points) + transforms[:, :3, 3]
