"""Reader of CARMEN logs: FLASER, RLASER, ODOM, ROBOTLASERk and RAWLASERk, plain or gzip."""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from slam.io._carmen_records import LaserRecord, OdomRecord
from slam.io._carmen_stream import RawLog, read_records
from slam.io.log import Event, LaserScan, Log, LogError, OdometryReading, planar_transform
from spplanes._check import FloatArray

if TYPE_CHECKING:
    from slam.rig import Rig

#: A SICK LMS reports errors as the largest of its 13-bit readings: what they look like, and what to take as none, m.
_SICK_MODES = ((8.1, 8.2, 7.95), (81.0, 82.0, 40.0))
#: Offsets of a laser pose against the robot's that differ by less than this are one mount, m and rad.
_SAME_MOUNT = 1e-4


def read_carmen(
    path: Path | str, *, rig: Rig | None = None, keep_partial: bool = False, clock: Literal["ipc", "logger"] = "ipc"
) -> Log:
    """Read a CARMEN log.

    Sensors carry the rig's names; lasers the rig does not have are left out. Without a rig a sensor has the name of its
    records. Ranges at or beyond the maximum (the rig's, the record's, or, for FLASER and RLASER alone, what the
    readings of a SICK show), at or below the rig's minimum, and not above zero become NaN. FLASER and RLASER do not
    state their bearings: odd counts span -90 to 90 deg, even ones -90 deg to one step short of 90.

    Odometry is that of ODOM, FLASER and RLASER; of ROBOTLASERk only in a log that has no other. A scan's
    `world_T_body` is the pose its record gives, with the laser's mount taken off where the log tells it.

    Args:
        path: the log, plain or gzip, whatever its name.
        rig: sensors, or None.
        keep_partial: keep what was read before a gzip stream or the last line breaks off.
        clock: "ipc": the time the sensor stamped (the log's third word from the end); "logger": the time the logger
            wrote the record (the last word). Where all ipc times are the same, the logger's are taken.

    Raises:
        LogError: one sentence with file and line: no lasers, a wrong count, text for a number, time running backwards
            within the records of one sensor, beam counts that change, a stream cut in the middle.
    """
    path = Path(path)
    raw = read_records(path, keep_partial)
    if not any(isinstance(record, LaserRecord) for record in raw.records):
        raise LogError(path, "expected a CARMEN log with laser records, got none")
    which = _choose_clock(raw, clock)
    _check_order(path, raw, which)
    lasers = [record for record in raw.records if isinstance(record, LaserRecord)]
    names = _names_of(path, lasers, rig, raw)
    limits = {name: _range_limit([r for r in lasers if r.name == name], rig, names[name]) for name in names}
    mounts = {name: _stated_mount(name, lasers, raw.offsets) for name in names}
    own_odometry = any(isinstance(r, OdomRecord) or r.angles is None for r in raw.records)

    events: list[Event] = []
    for record in raw.records:
        stamp = record.stamps_ns[which]
        if isinstance(record, OdomRecord):
            events.append(OdometryReading(stamp, planar_transform(*record.pose)))
        elif record.name in names:
            events += _events_of(record, stamp, names[record.name], limits[record.name], mounts[record.name], rig)
            if record.robot_pose is not None and (record.angles is None or not own_odometry):
                events.append(OdometryReading(stamp, planar_transform(*record.robot_pose)))
    events.sort(key=lambda event: (event.stamp_ns, not isinstance(event, OdometryReading)))
    stated = {names[name]: mount for name, mount in mounts.items() if mount is not None}
    return Log(events, path, raw.notes, stated)


def _choose_clock(raw: RawLog, clock: str) -> int:
    """Index of the time to take: 0 the sensor's, 1 the logger's."""
    stuck = len(raw.records) > 1 and len({record.stamps_ns[0] for record in raw.records}) == 1
    if clock == "ipc" and stuck and len({record.stamps_ns[1] for record in raw.records}) > 1:
        raw.notes.append("all ipc times are the same; took the logger's")
        return 1
    return 0 if clock == "ipc" else 1


def _check_order(path: Path, raw: RawLog, which: int) -> None:
    """Within the records of one name, time must not run backwards and the number of beams must not change."""
    last: dict[str, tuple[int, int]] = {}
    for record, number in zip(raw.records, raw.lines, strict=True):
        name = record.name if isinstance(record, LaserRecord) else "ODOM"
        beams = record.ranges.size if isinstance(record, LaserRecord) else 0
        stamp, seen = last.get(name, (record.stamps_ns[which], beams))
        if record.stamps_ns[which] < stamp:
            late = (stamp - record.stamps_ns[which]) / 1e9
            raise LogError(path, f"time runs backwards by {late:.6f} s in {name}", line=number)
        if beams != seen:
            raise LogError(path, f"expected {seen} beams as in the {name} records before, got {beams}", line=number)
        last[name] = (record.stamps_ns[which], beams)


def _names_of(path: Path, lasers: list[LaserRecord], rig: Rig | None, raw: RawLog) -> dict[str, str]:
    """Name of the sensor for each record name that is kept."""
    counts = Counter(record.name for record in lasers)
    if rig is None:
        return {name: name for name in counts}
    names = {name: sensor for name in counts if (sensor := rig.name_of_record(name)) is not None}
    raw.notes += [
        f"skipped {n} {name} records, which the rig does not have" for name, n in counts.items() if name not in names
    ]
    if not names:
        raise LogError(path, f"expected records of the rig's sensors, got only {', '.join(counts)}")
    return names


def _range_limit(records: list[LaserRecord], rig: Rig | None, sensor: str) -> float:
    """Ranges at or beyond this are no returns, m."""
    if rig is not None:
        return rig.sensors[sensor].range_max_m
    stated = [record.range_max_m for record in records if record.range_max_m is not None]
    limit = min(stated, default=np.inf)
    ranges = np.concatenate([record.ranges for record in records])
    largest = float(np.max(ranges, initial=0.0, where=np.isfinite(ranges)))
    return min([limit, *(none for low, high, none in _SICK_MODES if low <= largest <= high)])


def _stated_mount(name: str, lasers: list[LaserRecord], offsets: dict[str, float]) -> FloatArray | None:
    """body_T_sensor as PARAM lines, or poses of laser and robot that keep one distance, tell it; None: not told."""
    pairs = [r for r in lasers if r.name == name and r.laser_pose is not None and r.robot_pose is not None]
    if name in offsets:
        return planar_transform(offsets[name], 0.0, np.pi if name == "RLASER" else 0.0)
    if not pairs:
        return None
    relative = np.array([_relative(r.robot_pose, r.laser_pose) for r in pairs])  # type: ignore[arg-type]
    middle = np.median(relative, axis=0)
    if np.abs(relative - middle).max() > _SAME_MOUNT or (name == "RLASER" and not middle.any()):
        return None
    return planar_transform(*(middle + 0.0))  # no negative zeros


def _relative(robot: FloatArray, laser: FloatArray) -> FloatArray:
    """Pose of the laser in the frame of the robot, (x, y, theta)."""
    c, s = math.cos(robot[2]), math.sin(robot[2])
    dx, dy = (laser - robot)[:2].tolist()
    turn = math.remainder(laser[2] - robot[2], 2.0 * math.pi)
    return np.array([c * dx + s * dy, -s * dx + c * dy, turn], dtype=np.float64)


def _events_of(
    record: LaserRecord, stamp: int, sensor: str, limit: float, mount: FloatArray | None, rig: Rig | None
) -> list[Event]:
    least = 0.0 if rig is None else rig.sensors[sensor].range_min_m
    ranges = np.where((record.ranges > least) & (record.ranges < limit), record.ranges, np.nan)
    return [LaserScan(stamp, sensor, ranges, _angles(record, sensor, rig), _world_T_body(record, mount))]


def _angles(record: LaserRecord, sensor: str, rig: Rig | None) -> FloatArray:
    """Bearings: the rig's, else the record's, else those of a SICK with that many beams."""
    n = record.ranges.size
    if rig is not None:
        described = rig.sensors[sensor]
        if described.first_angle_deg is not None and described.angle_step_deg is not None:
            return np.deg2rad(described.first_angle_deg + described.angle_step_deg * np.arange(n))
    if record.angles is not None:
        return record.angles
    return np.pi * np.arange(n, dtype=np.float64) / max(n - n % 2, 1) - np.pi / 2.0


def _world_T_body(record: LaserRecord, mount: FloatArray | None) -> FloatArray | None:
    if record.angles is not None:
        return None if record.robot_pose is None else planar_transform(*record.robot_pose)
    assert record.laser_pose is not None
    world_T_laser = planar_transform(*record.laser_pose)
    return world_T_laser if mount is None else world_T_laser @ np.linalg.inv(mount)
