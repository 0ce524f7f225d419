"""Reader of CARMEN logs: FLASER, RLASER, ODOM, ROBOTLASERk and RAWLASERk, plain or gzip."""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import planar_transform
from slam.io.carmen_records import RawLog, read_records
from slam.io.raw import seconds_from_ns
from slam.io.scan_files import in_order
from slam.lazy import Spool
from slam.sensors.log import Event, LaserScan, Log, OdometryReading, StoredReading, StoredScan
from slam.sensors.rig import Rig
from spplanes._check import FloatArray

#: A SICK LMS reports errors as the largest of its 13-bit readings: what they look like, and what to take as none, m.
_SICK_MODES = ((8.1, 8.2, 7.95), (81.0, 82.0, 40.0))
#: Records that several programs write at once come late by this much at most, ns: they are sorted.
_LATE_NS = 1_000_000_000


def read_carmen(path: Path | str, *, rig: Rig | None = None, keep_partial: bool = False) -> Log:
    """Read a CARMEN log.

    Sensors carry the rig's names; lasers the rig does not have are left out. Without a rig a sensor has the name of its
    records. Ranges at or beyond the maximum (the rig's, the record's, or, for FLASER and RLASER alone, what the
    readings of a SICK show), at or below the rig's minimum, and not above zero become NaN. FLASER and RLASER do not
    state their bearings: odd counts span -90 to 90 deg, even ones -90 deg to one step short of 90.

    Times are those that the sensors stamped, a record's third word from the end; where these are all the same, those at
    which the logger wrote, the last word. Odometry is that of ODOM, FLASER and RLASER; of ROBOTLASERk only in a log
    that has no other. A scan's `world_T_body` is the pose its record gives, with the laser's mount taken off where the
    log tells it.

    Args:
        path: the log, plain or gzip, whatever its name.
        rig: sensors, or None.
        keep_partial: keep what was read before a gzip stream or the last line breaks off.

    Raises:
        LogError: one sentence with file and line: no lasers, a wrong count, text for a number, time running backwards
            within the records of one sensor, beam counts that change, a stream cut in the middle, no room for scans.

    The ranges of a long log wait on the disk (`slam.lazy.Spool`); every scan reads its own when it is asked for them.
    """
    path = Path(path)
    raw = read_records(path, keep_partial)
    rows = raw.rows()
    if not (rows["name"] > 0).any():
        raise LogError(path, "expected a CARMEN log with laser records, got none")
    stamps, loggers = rows["stamps_ns"].T
    if (stamps == stamps[0]).all() and (loggers != loggers[0]).any():
        raw.notes.append("all ipc times are the same; took the logger's")
        stamps = loggers
    times = _times(path, raw, rows, stamps)
    lasers = _lasers_of(path, raw, rows, rig)
    stated = {laser.sensor: laser.mount for laser in lasers.values() if laser.mount is not None}
    moved = np.isin(rows["name"], list(lasers)) & (times != stamps)
    stamped = dict(zip(times[moved].tolist(), stamps[moved].tolist(), strict=True))
    return Log(_events_of(rows, times, lasers), path, raw.notes, stated, stamped_ns=stamped)


def _events_of(rows: np.ndarray, times: np.ndarray, lasers: dict[int, TableScans]) -> list[Event]:
    """Scans and readings of a table, in time order."""
    own_odometry = bool(((rows["name"] == 0) | np.isnan(rows["start"])).any())
    tells_odometry = np.isfinite(rows["robot_pose"][:, 0]) & (np.isnan(rows["start"]) | (not own_odometry))
    readers = {number: {"ranges": laser.ranges, "world_T_body": laser.pose} for number, laser in lasers.items()}
    told = [rows[name].tolist() for name in ("name", "beams", "start", "step")]
    pose = {"odom_T_body": lambda row: planar_transform(*rows["robot_pose"][row])}
    events: list[Event] = []
    for row, (time, number, *bearings) in enumerate(zip(times.tolist(), *told, strict=True)):
        if number in lasers:
            known = {"stamp_ns": time, "sensor": lasers[number].sensor, "angles": lasers[number].angles(*bearings)}
            events.append(StoredScan(known, readers[number], row))
        if (number == 0 or number in lasers) and tells_odometry[row]:
            events.append(StoredReading({"stamp_ns": time}, pose, row))
    return in_order(events)


def _times(path: Path, raw: RawLog, rows: np.ndarray, stamps: np.ndarray) -> np.ndarray:
    """When every record was made, shape (N,), ns: what it is stamped, or where stamps run back as it was written.

    Programs that write at once each have their own clock's order, and late records are sorted. A program that was held
    up stamps late what it writes in order; then the poses in the records go back and forth by the stamps, and on the
    shortest way as written. A time that runs back by more than a moment is another log, or damage.
    """
    late, worst = 0, 0
    for name, number in raw.names.items():
        (own,) = np.nonzero(rows["name"] == number)
        behind = np.maximum.accumulate(stamps[own]) - stamps[own]
        (far,) = np.nonzero(behind > _LATE_NS)
        if far.size:
            problem = f"time runs backwards by {behind[far[0]] / 1e9:.6f} s in {name}"
            raise LogError(path, problem, line=int(rows["line"][own[far[0]]]))
        late, worst = late + int((behind > 0).sum()), max(worst, int(behind.max(initial=0)))
    if not late:
        return stamps
    poses = rows["robot_pose"][np.argsort(stamps, kind="stable")]
    as_written = _way(rows["robot_pose"]) < _way(poses)
    taken = "took as written" if as_written else "sorted"
    raw.notes.append(f"{taken} {late} records whose time runs back by up to {worst / 1e9:.3f} s")
    return _as_written(stamps) if as_written else stamps


def _way(poses: FloatArray) -> float:
    """Length of the way along poses (N, 3), of which some may be unknown, and how far it turns: m and rad, added."""
    steps = np.diff(poses[np.isfinite(poses[:, 0])], axis=0)
    turns = np.abs(np.remainder(steps[:, 2] + np.pi, 2.0 * np.pi) - np.pi)
    return float(np.sum(np.hypot(steps[:, 0], steps[:, 1])) + np.sum(turns))


def _as_written(stamps: np.ndarray) -> np.ndarray:
    """Times that ascend in the order of the records, shape (N,), ns: no record is made after it is stamped.

    Nor is one after what a later one is stamped; those that were held up are spread from the time before evenly.
    """
    latest = np.minimum.accumulate(stamps[::-1])[::-1]
    ends, first, number, count = np.unique(latest, return_index=True, return_inverse=True, return_counts=True)
    starts = np.concatenate((ends[:1], ends[:-1]))
    place = np.arange(len(stamps)) - first[number] + 1
    spread = starts[number] + (ends - starts)[number] * place // count[number]
    held_up = np.bincount(number, latest < stamps) > 0
    return np.where(held_up[number], spread, stamps)


def _lasers_of(path: Path, raw: RawLog, rows: np.ndarray, rig: Rig | None) -> dict[int, TableScans]:
    """The scans of every laser that is kept, by the number of its records."""
    lasers: dict[int, TableScans] = {}
    records = {name: number for name, number in raw.names.items() if number}
    for name, number in records.items():
        own = rows[rows["name"] == number]
        sensor = name if rig is None else rig.name_of_record(name)
        if sensor is None:
            raw.notes.append(f"skipped {len(own)} {name} records, which the rig does not have")
            continue
        limits, angles = (0.0, _range_limit(own)), (None, None)
        if rig is not None:
            told = rig.sensors[sensor]
            limits, angles = (told.range_min_m, told.range_max_m), (told.first_angle_deg, told.angle_step_deg)
        mount = _stated_mount(name, own, raw.offsets)
        lasers[number] = TableScans(sensor, rows, raw.spool, *limits, mount, angles)
    if not lasers:
        raise LogError(path, f"expected records of the rig's sensors, got only {', '.join(records)}")
    return lasers


def _range_limit(own: np.ndarray) -> float:
    """Ranges of a laser at or beyond this are no returns, m: what is stated, what a SICK says, or the same reading.

    What is far away is hardly ever read as the same number twice; what stands for nothing is the largest reading of
    five scans at least, and of five times more than any other is.
    """
    stated, largest = own["range_max_m"], float(own["largest"].max())
    limits = [float(np.min(stated, initial=np.inf, where=~np.isnan(stated)))]
    limits += [none for low, high, none in _SICK_MODES if low <= largest <= high]
    values, counts = np.unique(np.round(own["largest"], 3), return_counts=True)
    if counts[-1] >= max(5, 5 * counts[:-1].max(initial=1)):
        limits.append(float(values[-1]))
    return min(limits)


def _stated_mount(name: str, own: np.ndarray, offsets: dict[str, float]) -> FloatArray | None:
    """body_T_sensor as PARAM lines, or poses of laser and robot that keep one distance, tell it; None: not told."""
    pairs = own[np.isfinite(own["laser_pose"][:, 0]) & np.isfinite(own["robot_pose"][:, 0])]
    if name in offsets:
        return planar_transform(offsets[name], 0.0, np.pi if name == "RLASER" else 0.0)
    if not len(pairs):
        return None
    relative = np.array(list(map(_relative, pairs["robot_pose"], pairs["laser_pose"])))
    middle = np.median(relative, axis=0)  # what differs by less than 1e-4 m and rad is one mount
    if np.abs(relative - middle).max() > 1e-4 or (name == "RLASER" and not middle.any()):
        return None
    return planar_transform(*(middle + 0.0))  # no negative zeros


def _relative(robot: FloatArray, laser: FloatArray) -> FloatArray:
    """Pose of the laser in the frame of the robot, (x, y, theta)."""
    c, s = math.cos(robot[2]), math.sin(robot[2])
    dx, dy = (laser - robot)[:2].tolist()
    turn = math.remainder(laser[2] - robot[2], 2.0 * math.pi)
    return np.array([c * dx + s * dy, -s * dx + c * dy, turn], dtype=np.float64)


@dataclass(frozen=True, eq=False)
class TableScans:
    """What the scans of one laser have in common."""

    sensor: str
    rows: np.ndarray
    """The table: dtype `slam.io.carmen_records.ROW`."""
    spool: Spool
    """Ranges as written."""
    least_m: float
    """Ranges up to this are no returns."""
    limit_m: float
    """Ranges at or beyond this are none."""
    mount: FloatArray | None
    """body_T_sensor as the log tells it, shape (4, 4)."""
    angles_deg: tuple[float | None, float | None]
    """The first bearing and the step, as the rig tells them; None: it does not."""
    _bearings: dict[tuple[float, ...], FloatArray] = field(default_factory=dict)
    """Those made already: scan after scan has the same."""

    def ranges(self, row: int) -> FloatArray:
        """Ranges of a record, shape (B,), m; NaN = no return."""
        record = self.rows[row]
        written = self.spool.get(int(record["place"]), int(record["beams"]))
        return np.where((written > self.least_m) & (written < self.limit_m), written, np.nan)

    def angles(self, count: int, start: float, step: float) -> FloatArray:
        """Bearings, shape (B,), rad: the rig's, else the record's, else those of a SICK with that many beams."""
        key = (count, start, step) if np.isfinite(start) else (count,)  # NaN is never the same
        if key not in self._bearings:
            beams, (first, between) = np.arange(count, dtype=np.float64), self.angles_deg
            if first is not None and between is not None:
                self._bearings[key] = np.deg2rad(first + between * beams)
            elif np.isfinite(start):
                self._bearings[key] = start + step * beams
            else:
                self._bearings[key] = np.pi * beams / max(count - count % 2, 1) - np.pi / 2.0
        return self._bearings[key]

    def pose(self, row: int) -> FloatArray | None:
        """world_T_body of a record, shape (4, 4); None: it gives none."""
        record = self.rows[row]
        if np.isfinite(record["start"]):
            return planar_transform(*record["robot_pose"]) if np.isfinite(record["robot_pose"][0]) else None
        world_T_laser = planar_transform(*record["laser_pose"])
        return world_T_laser if self.mount is None else world_T_laser @ np.linalg.inv(self.mount)


def write_carmen(log: Log, rig: Rig, path: Path | str) -> None:
    """Write a log of 2D lasers and odometry, gzip if the name ends in .gz.

    Numbers are the shortest that read back to the same float: `read_carmen` with the same rig returns the same ranges,
    bit for bit, and bearings to rounding error. No returns are written as the maximum range. A scan without a pose of
    its own gets the last odometry before it. Equal logs give equal bytes.

    Raises:
        ValueError: an event that CARMEN has no record for, or a sensor whose record is not ROBOTLASERk.
    """
    path = Path(path)
    text = "".join(line + "\n" for line in _lines(log, rig)).encode("ascii")
    path.write_bytes(gzip.compress(text, compresslevel=6, mtime=0) if path.suffix == ".gz" else text)


def _lines(log: Log, rig: Rig) -> Iterator[str]:
    yield "# CARMEN log: metres, radians; see rig.yaml for mounts and noise"
    last = np.eye(4)
    for event in log.events:
        if isinstance(event, OdometryReading):
            last = event.odom_T_body
            yield f"ODOM {_pose(last)} 0 0 0 {_tail(event.stamp_ns)}"
        elif isinstance(event, LaserScan):
            yield _laser(event, rig, last if event.world_T_body is None else event.world_T_body)
        else:
            raise ValueError(f"log: expected 2D scans and odometry only, got a 3D scan of {event.sensor!r}")


def _laser(scan: LaserScan, rig: Rig, world_T_body: FloatArray) -> str:
    """ROBOTLASERk type start fov step max accuracy mode n r... 0 laser robot tv rv front side axis t host t."""
    sensor = rig.sensors[scan.sensor]
    record = sensor.record or scan.sensor
    if not record.startswith("ROBOTLASER"):
        raise ValueError(f"rig: expected a record ROBOTLASERk for {scan.sensor!r}, got {record!r}")
    step = float(scan.angles[-1] - scan.angles[0]) / max(len(scan.angles) - 1, 1)
    if not np.allclose(np.diff(scan.angles), step, rtol=0.0, atol=1e-9):
        raise ValueError(f"log: expected equally spaced bearings from {scan.sensor!r}, got unequal ones")
    ranges = np.where(np.isnan(scan.ranges), sensor.range_max_m, scan.ranges)
    head = f"{float(scan.angles[0])!r} {step * (len(scan.angles) - 1)!r} {step!r} {sensor.range_max_m!r}"
    body = " ".join(map(repr, ranges.tolist()))
    poses = f"{_pose(world_T_body @ sensor.body_T_sensor)} {_pose(world_T_body)}"
    tail = f"0 0 0 0 0 {_tail(scan.stamp_ns)}"
    return f"{record} 0 {head} {sensor.range_sigma_m!r} 0 {len(ranges)} {body} 0 {poses} {tail}"


def _pose(transform: FloatArray) -> str:
    x, y = transform[:2, 3].tolist()
    theta = float(np.arctan2(transform[1, 0], transform[0, 0]))
    return f"{x!r} {y!r} {theta!r}"


def _tail(stamp_ns: int) -> str:
    return f"{seconds_from_ns(stamp_ns)} simulation {seconds_from_ns(stamp_ns)}"
