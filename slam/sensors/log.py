"""What every reader returns: sensor data in time order, metric, right-handed, time in integer nanoseconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.lazy import Stored
from spplanes._check import FloatArray, as_float_array
from spplanes.clouds.turn import TurnBegin, begin_of


@dataclass(frozen=True, eq=False)
class LaserScan:
    """One revolution of a 2D laser."""

    stamp_ns: int
    """Time of the first beam, ns."""
    sensor: str
    """Name of the sensor in the rig."""
    ranges: FloatArray
    """Range per beam, shape (B,), m; NaN = no return."""
    angles: FloatArray
    """Bearing per beam in the sensor's scan plane (x forward, y left), shape (B,), rad."""
    world_T_body: FloatArray | None = None
    """Pose of the robot that the record itself gives, localised or not, shape (4, 4); None: it gives none."""


@dataclass(frozen=True, eq=False)
class CloudScan:
    """One 3D scan in the sensor's frame."""

    stamp_ns: int
    """Time of the scan, ns."""
    sensor: str
    """Name of the sensor in the rig."""
    points: FloatArray
    """Organised, shape (S, B, 3), or unorganised, shape (N, 3), m; NaN = no return."""
    world_T_body: FloatArray | None = None
    """Pose of the robot that comes with the scan, shape (4, 4); None: none does."""
    turn: tuple[float, float] | None = None
    """Where the turn of a spinning sensor began, by the order in which the points came: azimuth, rad, and 1 or -1
    (clockwise); a way of 0: they came in none. None: the points are in the order in which they came."""

    @property
    def begin(self) -> TurnBegin | None:
        """The same; None: no order shows it."""
        if self.turn is None:
            return begin_of(as_float_array("points", self.points))
        azimuth_rad, way = self.turn
        return TurnBegin(azimuth_rad, way < 0.0) if way else None


class StoredCloud(Stored, CloudScan):
    """A 3D scan that stays in its file until its points are asked for: long logs need not fit into memory.

    To ask for them raises `LogError` where the file is damaged.
    """


@dataclass(frozen=True, eq=False)
class OdometryReading:
    """Pose of the robot according to its odometry."""

    stamp_ns: int
    """Time of the reading, ns."""
    odom_T_body: FloatArray
    """Body in the odometry frame, shape (4, 4)."""


class StoredScan(Stored, LaserScan):
    """A 2D scan whose ranges, and pose if there is one, are read each time they are asked for."""


class StoredReading(Stored, OdometryReading):
    """An odometry reading whose transform is made each time it is asked for."""


Event = LaserScan | CloudScan | OdometryReading


@dataclass(frozen=True, eq=False)
class Log:
    """A mission as the sensors told it."""

    events: list[Event]
    """In time order; of equal times odometry comes first."""
    source: Path
    """File or folder it was read from."""
    notes: list[str] = field(default_factory=list)
    """What the reader skipped or repaired, one sentence each."""
    mounts: dict[str, FloatArray] = field(default_factory=dict)
    """body_T_sensor (4, 4) of the sensors whose mount the log itself tells."""
    odometry_source: Path | None = None
    """File that the odometry was taken from in place of the log's own; None: it is the log's own."""
    assumed: list[str] = field(default_factory=list)
    """What was taken for granted because nobody said it, one sentence each."""
    stamped_ns: dict[int, int] = field(default_factory=dict)
    """What scans that came at another time were stamped, by that time, ns."""

    @property
    def odometry(self) -> list[OdometryReading]:
        """The odometry readings, in time order."""
        return [event for event in self.events if isinstance(event, OdometryReading)]

    @property
    def measured_motion(self) -> list[OdometryReading]:
        """The odometry readings; none where all are of one pose: odometry that never moves says nothing of a motion."""
        readings = self.odometry
        moves = any(not np.array_equal(reading.odom_T_body, readings[0].odom_T_body) for reading in readings[1:])
        return readings if moves else []

    def as_stamped(self, times_ns: Sequence[int]) -> np.ndarray:
        """What scans of these times were stamped, shape (N,), int64, ns."""
        return np.array([self.stamped_ns.get(time, time) for time in times_ns], dtype=np.int64)

    def scans(self, sensor: str | None = None) -> list[LaserScan | CloudScan]:
        """The scans of one sensor, or of all, in time order."""
        return [
            event
            for event in self.events
            if not isinstance(event, OdometryReading) and (sensor is None or event.sensor == sensor)
        ]
