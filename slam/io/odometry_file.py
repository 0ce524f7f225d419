"""Odometry from a file of its own, in place of what a log has."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory, read_tum
from slam.sensors.log import Event, Log, OdometryReading
from spplanes._check import FloatArray

#: A scan has odometry where it lies between readings, or at most this far before the first or after the last, ns.
REACH_NS = 500_000_000


def with_odometry(log: Log, path: Path, body_T_sensor: FloatArray | None = None) -> Log:
    """The log with the poses of a TUM file for odometry; its own is left out, and a note says so.

    Args:
        log: of any kind that has times.
        path: odom_T_body, in a frame of its own.
        body_T_sensor: where the file tells the poses of a sensor, its mount, shape (4, 4).

    Raises:
        LogError: a file that is none, or that does not reach all scans: where odometry is missing it would seem to say
            that the robot stood.
    """
    scans: list[Event] = [event for event in log.events if not isinstance(event, OdometryReading)]
    readings = readings_of(path, scans, body_T_sensor)
    note = taken_from(path, len(readings), len(log.events) - len(scans))
    return replace(log, events=in_order([*readings, *scans]), notes=[*log.notes, note], odometry_source=path)


def readings_of(path: Path, scans: Iterable[Event], body_T_sensor: FloatArray | None = None) -> list[OdometryReading]:
    """The readings of a TUM file for some scans; arguments and errors as of `with_odometry`."""
    rows = read_tum(path)
    check_reach(path, rows, (scan.stamp_ns for scan in scans))
    poses = rows.poses if body_T_sensor is None else rows.poses @ inverse(body_T_sensor)
    return list(map(OdometryReading, rows.stamps_ns.tolist(), poses))


def in_order(events: Iterable[Event]) -> list[Event]:
    """Events in time order; of equal times odometry comes first."""
    return sorted(events, key=lambda event: (event.stamp_ns, not isinstance(event, OdometryReading)))


def taken_from(path: Path, count: int, own: int = 0) -> str:
    """The sentence on odometry that was given."""
    left_out = f"; the log's own {own} readings are left out" if own else ""
    return f"odometry: {count} poses of {path.name}{left_out}"


def check_reach(path: Path, rows: Trajectory, stamps_ns: Iterable[int]) -> None:
    """Refuse odometry that does not reach all scans."""
    stamps = np.fromiter(stamps_ns, dtype=np.int64)
    outside = (stamps < rows.stamps_ns[0] - REACH_NS) | (stamps > rows.stamps_ns[-1] + REACH_NS)
    if outside.any():
        first, last = rows.stamps_ns[[0, -1]] * 1e-9
        raise LogError(
            path,
            f"expected odometry at the times of all {len(stamps)} scans, got it from {first:.3f} to {last:.3f} s, "
            f"beyond which {int(outside.sum())} lie, the first at {stamps[outside][0] * 1e-9:.3f} s",
        )
