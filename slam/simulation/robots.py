"""Simulated robots, the paper's with its 2D lasers and one with a spinning 3D laser, and the paths they drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from slam.sensors.log import CloudScan, LaserScan
from slam.sensors.rig import LocalisationNoise, Mount, OdometryNoise, Rig, Sensor
from spplanes._check import FloatArray
from spplanes.registration import beam_directions

#: Names of the sensors: the paper's two lasers, and the spinning one.
HORIZONTAL, VERTICAL, SPINNING = "horizontal", "vertical", "spinning"


#: The floors of the simulated worlds are level, and the robots neither pitch nor roll: a rig that said otherwise would
#: make every map look more cautious than it is.
ON_LEVEL_FLOOR = OdometryNoise(z_sigma_m=1e-4, pitch_sigma_rad=1e-4, roll_sigma_rad=1e-4)


@dataclass(frozen=True, eq=False)
class Beams:
    """Directions of the beams of a sensor, in fans that each lie in one plane."""

    directions: FloatArray
    """Unit directions in the sensor frame, shape (F, B, 3): F fans of B beams."""
    normals: FloatArray
    """Normal of each fan's plane, shape (F, 3)."""
    angles: FloatArray | None
    """Bearings of the one fan of a 2D laser, shape (B,), rad; None for a 3D one."""

    @classmethod
    def of_laser(cls, angles: FloatArray) -> Beams:
        """A 2D laser with bearings (B,), rad."""
        return cls(beam_directions(angles)[None], np.array([[0.0, 0.0, 1.0]]), angles)

    @classmethod
    def of_spinning(cls, azimuths: FloatArray, elevations: FloatArray) -> Beams:
        """A 3D laser: at each azimuth (F,) a fan of elevations (B,), rad."""
        c, s = np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]
        level, rise = np.cos(elevations), np.sin(elevations)
        directions = np.stack([c * level, s * level, np.broadcast_to(rise, (len(azimuths), len(elevations)))], axis=-1)
        return cls(directions, np.column_stack([s, -c, np.zeros_like(c)]), None)

    def scan(
        self, stamp_ns: int, sensor: str, ranges: FloatArray, world_T_body: FloatArray | None = None
    ) -> LaserScan | CloudScan:
        """What is recorded of ranges (F B,), m; a 2D laser's scan may tell its pose (4, 4)."""
        if self.angles is not None:
            return LaserScan(stamp_ns, sensor, ranges, self.angles, world_T_body)
        return CloudScan(stamp_ns, sensor, ranges.reshape(self.directions.shape[:2])[..., None] * self.directions)


#: 361 beams over 180 deg as in the paper; its two opposing horizontal lasers as one of 360 deg; 32 rings.
BEAMS = {
    VERTICAL: Beams.of_laser(np.deg2rad(np.arange(-240, 121) * 0.5)),
    HORIZONTAL: Beams.of_laser(np.deg2rad(np.arange(-360, 360) * 0.5)),
    SPINNING: Beams.of_spinning(np.deg2rad(np.arange(-180.0, 180.0)), np.deg2rad(np.linspace(-30.0, 60.0, 32))),
}


def paper_rig() -> Rig:
    """The robot of the paper: a level 360 deg laser for lines, a vertical push-broom laser for 3D, drifting wheels.

    The vertical laser scans the plane across the robot, 0.4 m above the floor: its x axis points up, y to the left.
    Its 180 deg are turned 30 deg to the right (bearings -120 to 60 deg), so that they reach from a strip of floor on
    the right over the ceiling to the upper left wall: all four sides of a corridor in every scan.
    """
    noise: dict[str, Any] = {"range_sigma_m": 0.015, "range_max_m": 40.0}
    level = Mount(xyz_m=(0.0, 0.0, 0.3))
    upright = Mount(xyz_m=(0.0, 0.0, 0.4), rpy_deg=(0.0, -90.0, 0.0))
    return Rig(
        sensors={
            HORIZONTAL: Sensor(kind="line", body_T_sensor=level, record="ROBOTLASER1", **noise),
            VERTICAL: Sensor(kind="slice", body_T_sensor=upright, record="ROBOTLASER2", **noise),
        },
        odometry=ON_LEVEL_FLOOR,
        localisation=LocalisationNoise(),
    )


def spinning_rig() -> Rig:
    """A robot with a 3D laser 0.8 m above the floor: 32 rings from -30 to 60 deg, 1 deg in azimuth, sigma 15 mm."""
    mount = Mount(xyz_m=(0.1, 0.0, 0.8))
    sensor = Sensor(kind="cloud", body_T_sensor=mount, range_sigma_m=0.015, range_max_m=60.0)
    return Rig(sensors={SPINNING: sensor}, odometry=ON_LEVEL_FLOOR)


def checked_rig(rig: Rig) -> Rig:
    """The rig; ValueError: a sensor that cannot be simulated, or bearing noise of a 3D one."""
    for name, sensor in rig.sensors.items():
        if name not in BEAMS:
            raise ValueError(f"rig: expected sensors among {', '.join(BEAMS)}, got {name!r}")
        if BEAMS[name].angles is None and sensor.bearing_sigma_rad > 0.0:
            raise ValueError(f"rig: expected bearing noise of 2D lasers only, got it of {name!r}")
    return rig


#: Distance between the stored points of a path, m.
_STEP_M = 0.005


@dataclass(frozen=True, eq=False)
class Path:
    """A curve on the floor: way driven up to each point (K,), m, from 0; x, y, heading there (K, 3), not wrapped."""

    way_m: FloatArray
    poses: FloatArray

    @property
    def length_m(self) -> float:
        """Length of the whole path, m."""
        return float(self.way_m[-1])

    def at(self, way_m: FloatArray) -> FloatArray:
        """Poses (N, 3) after the ways (N,), m."""
        return np.column_stack([np.interp(way_m, self.way_m, column) for column in self.poses.T])

    @classmethod
    def through(cls, points: ArrayLike) -> Path:
        """The path along a dense curve of points (K, 2); the heading is its tangent."""
        curve = np.asarray(points, dtype=np.float64)
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        tangent = np.gradient(curve, way, axis=0)
        heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        return cls(way, np.column_stack([curve, heading]))

    @classmethod
    def weaving(cls, length_m: float) -> Path:
        """Along x from the origin, heading 0 at the start, swinging 0.06 m to the left and back every 7 m."""
        swing, wave = 0.06, 7.0
        x = np.arange(0.0, length_m + 1.0, _STEP_M)
        phase = 2.0 * np.pi * x / wave
        path = cls.through(np.column_stack([x, swing * (1.0 - np.cos(phase)) / 2.0]))
        path.poses[:, 2] = np.arctan(swing * np.pi / wave * np.sin(phase))  # exactly 0 at the start
        return path

    @classmethod
    def rounded(cls, points: Sequence[tuple[float, float]], radius_m: float) -> Path:
        """Straight from point to point, corners cut by arcs of `radius_m`; ValueError: one does not fit."""
        pieces: list[FloatArray] = []
        corners = np.asarray(points, dtype=np.float64)
        here = corners[0]
        for corner, following in pairwise(corners[1:]):
            arc = _arc(here, corner, following, radius_m)
            if (arc[0] - here) @ (corner - here) < 0.0 or (following - arc[-1]) @ (following - corner) < 0.0:
                raise ValueError(f"radius_m: expected arcs that fit between the points, got {radius_m} at {corner}")
            pieces += [_straight(here, arc[0]), arc[:-1]]
            here = arc[-1]
        return cls.through(np.vstack([*pieces, _straight(here, corners[-1]), corners[-1:]]))


def _straight(start: FloatArray, end: FloatArray) -> FloatArray:
    """Points (K, 2) from start to just before end."""
    count = max(int(np.ceil(np.linalg.norm(end - start) / _STEP_M)), 1)
    return start + np.arange(count)[:, None] / count * (end - start)


def _arc(before: FloatArray, corner: FloatArray, after: FloatArray, radius_m: float) -> FloatArray:
    """Points (K, 2) of the arc that touches both sides of a corner, from one touching point to the other."""
    incoming, outgoing = corner - before, after - corner
    incoming, outgoing = incoming / np.linalg.norm(incoming), outgoing / np.linalg.norm(outgoing)
    turn = np.arctan2(incoming[0] * outgoing[1] - incoming[1] * outgoing[0], incoming @ outgoing)
    start = corner - incoming * radius_m * np.tan(abs(turn) / 2.0)
    left = np.sign(turn) * np.array([-incoming[1], incoming[0]])
    angles = np.linspace(0.0, turn, max(int(abs(turn) * radius_m / _STEP_M), 2))
    c, s = np.cos(angles)[:, None], np.sin(np.abs(angles))[:, None]
    return start + radius_m * (left * (1.0 - c) + incoming * s)


def pose_matrices(poses: FloatArray) -> FloatArray:
    """(N, 4, 4) transforms of poses (N, 3) on the floor."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = c, -s, s, c
    matrices[:, :2, 3] = poses[:, :2]
    return matrices
