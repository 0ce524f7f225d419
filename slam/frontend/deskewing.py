"""A laser takes time over a scan, and the robot drives on: every beam from where the body was at its own moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import gtsam
import numpy as np

from slam.frontend.odometry import OdometryTrack, planar_delta
from slam.geometry.frames import inverse
from slam.sensors.log import LaserScan
from slam.sensors.rig import Sensor
from slam.sensors.scan_noise import model_of
from spplanes import Plane
from spplanes._check import FloatArray
from spplanes.clouds.turn import TurnBegin
from spplanes.registration import RegisteredScans

#: The body moves on evenly in so many parts of the turn of a spinning lidar.
_PARTS = 64
#: (x, y, heading) in GTSAM order; points of a plane that are asked when they were seen.
_PLANAR, _FEW = [3, 4, 2], 200


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


class Sweeps(NamedTuple):
    """How a body moves while its lidar turns."""

    track: OdometryTrack
    twist_covariance: FloatArray
    """Of what the track errs by about a scan: twist in the body frame, GTSAM order (rotation, translation), (6, 6),
    a second."""

    @classmethod
    def of_wheels(cls, track: OdometryTrack, stamp_ns: int, seconds: float) -> Sweeps:
        """By odometry, about a scan with a turn of so many seconds: it errs as on the way of half of one."""
        start, end = track.poses_at([stamp_ns, stamp_ns + round(0.5e9 * seconds)])
        (planar,) = track.noise.random_covariances([planar_delta(inverse(start) @ end)])
        twist = np.zeros((6, 6))
        twist[np.ix_(_PLANAR, _PLANAR)] = planar / (0.5 * seconds) ** 2
        return cls(track, twist)

    def unswept(self, points: FloatArray, sensor: Sensor, stamp_ns: int, begin: TurnBegin) -> FloatArray:
        """Points of a turn, (N, 3) or (S, B, 3), as if all had been taken at its middle, its stamp.

        Args:
            points: in the frame of the sensor as it was at the moment of each, m; NaN = no return.
            sensor: its `sweep_s`.
            stamp_ns: of the scan, ns.
            begin: where the turn begins.
        """
        parts = np.linspace(-0.5, 0.5, _PARTS + 1)
        times = (stamp_ns + np.round(1e9 * sensor.sweep_s * parts)).astype(np.int64).tolist()
        poses, mount, flat = self.track.onward([stamp_ns, *times]), sensor.body_T_sensor, points.reshape(-1, 3)
        moved = inverse(poses[0] @ mount) @ poses[1:] @ mount
        share = np.nan_to_num(begin.turned(flat)) * _PARTS
        part = np.minimum(share.astype(np.int64), _PARTS - 1)
        here, there = (_apply(moved[part + k], flat) for k in (0, 1))
        return (here + (share - part)[:, None] * (there - here)).reshape(points.shape)

    def blurred(self, plane: Plane, points: FloatArray, sensor: Sensor, begin: TurnBegin) -> Plane:
        """A plane in the sensor's frame, with what its points (N, 3) err by together where the motion errs."""
        few = points[:: max(len(points) // _FEW, 1)]
        times = sensor.sweep_s * (begin.turned(few) - 0.5)
        at_sensor = gtsam.Pose3(inverse(sensor.body_T_sensor)).AdjointMap()
        normal, local = plane.frame[:3, 2], (few - plane.frame[:3, 3]) @ plane.frame[:3, :3]
        off = times[:, None] * np.column_stack((np.cross(few, normal), np.broadcast_to(normal, few.shape)))
        heights = np.column_stack((np.ones(len(few)), -local[:, 0], local[:, 1]))
        errs = np.linalg.lstsq(heights, off, rcond=None)[0] @ at_sensor
        return replace(plane, covariance=plane.covariance + errs @ self.twist_covariance @ errs.T)


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
