"""One line of a CARMEN log to one record: counts, numbers and times checked, nothing interpreted yet."""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.errors import KEEPS_THE_REST, LogError
from slam.io._numbers import nanoseconds
from slam.io.packed import BROKEN, numbered_lines
from slam.io.spool import Spool
from spplanes._check import FloatArray

#: The words after the poses of every record: time of the sensor, host, time of the logger.
_TAIL = 3
_LASER = re.compile(r"(FLASER|RLASER|(?:ROBOT|RAW)LASER\d)$")
_KEYWORD = re.compile(r"[A-Z][A-Z0-9_]*$")
#: Laser offsets along the robot's axis that a log may state.
OFFSET_PARAMETERS = {"robot_frontlaser_offset": "FLASER", "robot_rearlaser_offset": "RLASER"}


@dataclass(frozen=True, eq=False)
class LaserRecord:
    """A scan as the log has it."""

    name: str
    """FLASER, RLASER, ROBOTLASER1 and so on."""
    ranges: FloatArray
    """As written, shape (B,), m."""
    bearings: tuple[float, float] | None
    """Of the first beam, and from one to the next, rad; None for FLASER and RLASER, which do not say."""
    range_max_m: float | None
    """Maximum range the record states, m."""
    laser_pose: FloatArray | None
    """Pose of the laser (x, y, theta); None where there is none."""
    robot_pose: FloatArray | None
    """Pose of the robot (x, y, theta); for FLASER and RLASER its odometry."""
    stamps_ns: tuple[int, int]
    """Time of the sensor and time of the logger, ns."""


@dataclass(frozen=True, eq=False)
class OdomRecord:
    """A pose of the odometry as the log has it."""

    pose: FloatArray
    """x, y, theta, m, m, rad."""
    stamps_ns: tuple[int, int]
    """Time of the sensor and time of the logger, ns."""


@dataclass(frozen=True)
class OffsetRecord:
    """A laser's offset along the robot's axis, from a PARAM line."""

    name: str
    """Record name of the laser."""
    offset_m: float
    """Forward, m."""


def parse_record(line: str) -> LaserRecord | OdomRecord | OffsetRecord | str:
    """The record in a line that is neither empty nor a comment; its keyword where it is of no use here.

    Raises:
        ValueError: one sentence on what is wrong with the line.
    """
    words = line.split()
    keyword = words[0]
    if keyword == "ODOM":
        return _odom(words)
    if _LASER.match(keyword):
        return _plain_laser(words) if keyword in ("FLASER", "RLASER") else _numbered_laser(words)
    if keyword == "PARAM" and len(words) > 2 and words[1] in OFFSET_PARAMETERS:
        return OffsetRecord(OFFSET_PARAMETERS[words[1]], float(_numbers(words[2:3])[0]))
    if not _KEYWORD.match(keyword):
        raise ValueError(f"expected a CARMEN record, got {keyword[:20]!r}")
    return keyword


def _odom(words: list[str]) -> OdomRecord:
    _check_length(words, 1 + 6 + _TAIL)
    return OdomRecord(_pose(words, 1), _stamps(words))


def _plain_laser(words: list[str]) -> LaserRecord:
    """FLASER n r... x y theta odom_x odom_y odom_theta t host t."""
    n = _count(words, 1)
    _check_length(words, 2 + n + 6 + _TAIL)
    ranges = _numbers(words[2 : 2 + n])
    return LaserRecord(words[0], ranges, None, None, _pose(words, 2 + n), _pose(words, 5 + n), _stamps(words))


def _numbered_laser(words: list[str]) -> LaserRecord:
    """ROBOTLASERk type start fov step max accuracy mode n r... m e... (laser pose, robot pose, 5 more) t host t."""
    n = _count(words, 8)
    m = _count(words, 9 + n) if len(words) > 9 + n else 0
    has_pose = words[0].startswith("ROBOT")
    _check_length(words, 10 + n + m + (11 if has_pose else 0) + _TAIL)
    start, _, step, range_max = _numbers(words[2:6])
    if not (np.isfinite(start) and np.isfinite(step) and step > 0.0):
        raise ValueError(f"expected a finite start angle and a positive step, got {words[2]} and {words[4]}")
    tail = 10 + n + m
    return LaserRecord(
        name=words[0],
        ranges=_numbers(words[9 : 9 + n]),
        bearings=(float(start), float(step)),
        range_max_m=float(range_max) if range_max > 0.0 else None,
        laser_pose=_pose(words, tail) if has_pose else None,
        robot_pose=_pose(words, tail + 3) if has_pose else None,
        stamps_ns=_stamps(words),
    )


def _count(words: list[str], place: int) -> int:
    """The number of readings at a place in the line; a number the line cannot hold is refused before it is used."""
    word = words[place] if place < len(words) else ""
    if not word.isdecimal() or int(word[:12]) > len(words):
        raise ValueError(f"expected as many readings as the line counts, got the count {word[:20]!r}")
    return int(word)


def _check_length(words: list[str], expected: int) -> None:
    if len(words) != expected:
        raise ValueError(f"expected {expected} words in this {words[0]} record, got {len(words)}")


def _numbers(words: list[str]) -> FloatArray:
    try:
        return np.array(words, dtype=np.float64)
    except ValueError:
        bad = next(word for word in words if not _is_number(word))
        raise ValueError(f"expected numbers, got {bad[:20]!r}") from None


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _pose(words: list[str], place: int) -> FloatArray:
    pose = _numbers(words[place : place + 3])
    if not np.isfinite(pose).all():
        raise ValueError(f"expected a finite pose, got {' '.join(words[place : place + 3])}")
    return pose


def _stamps(words: list[str]) -> tuple[int, int]:
    return nanoseconds(words[-3]), nanoseconds(words[-1])


#: Longer lines are refused before they fill the memory, bytes.
LONGEST_LINE = 1 << 20


#: A record without its ranges: NaN stands for what it does not tell. `place`: of its ranges in the spool.
ROW = np.dtype(
    [("stamps_ns", "<i8", 2), *((name, "<i8") for name in ("line", "name", "beams", "place"))]
    + [(name, "<f8") for name in ("start", "step", "range_max_m", "largest")]
    + [("laser_pose", "<f8", 3), ("robot_pose", "<f8", 3)]
)
_PACK = struct.Struct("<6q10d").pack
_NOT_TOLD = (math.nan,) * 3
ODOM = "ODOM"


@dataclass
class RawLog:
    """Everything read so far, in the order of the file."""

    spool: Spool
    """Ranges of all lasers."""
    names: dict[str, int] = field(default_factory=lambda: {ODOM: 0})
    """Number of each kind of record in the table."""
    packed: bytearray = field(default_factory=bytearray)
    """Rows of the table."""
    offsets: dict[str, float] = field(default_factory=dict)
    """Stated offset along the robot's axis by record name, m."""
    skipped: Counter[str] = field(default_factory=Counter)
    """How many records of other kinds there were, by keyword."""
    notes: list[str] = field(default_factory=list)
    """What was skipped or repaired, one sentence each."""

    def rows(self) -> np.ndarray:
        """The records of lasers and odometry: dtype `ROW`, shape (N,)."""
        return np.frombuffer(self.packed, dtype=ROW)

    def take(self, record: LaserRecord | OdomRecord, line: int) -> None:
        """Keep a record."""
        if isinstance(record, OdomRecord):
            told = (*_NOT_TOLD, math.nan, *_NOT_TOLD, *record.pose.tolist())
            self.packed += _PACK(*record.stamps_ns, line, 0, 0, 0, *told)
            return
        start, step = record.bearings or (math.nan, math.nan)
        largest = float(np.max(record.ranges, initial=0.0, where=np.isfinite(record.ranges)))
        number = self.names.setdefault(record.name, len(self.names))
        counted = (line, number, record.ranges.size, self.spool.put(record.ranges))
        poses = (*_plain(record.laser_pose), *_plain(record.robot_pose))
        range_max = math.nan if record.range_max_m is None else record.range_max_m
        self.packed += _PACK(*record.stamps_ns, *counted, start, step, range_max, largest, *poses)


def _plain(pose: FloatArray | None) -> tuple[float, ...]:
    return _NOT_TOLD if pose is None else tuple(pose.tolist())


def read_records(path: Path, keep_partial: bool) -> RawLog:
    """Read all records; a stream or a last line that breaks off is an error, or a note with `keep_partial`."""
    raw, number = RawLog(Spool(path)), 0
    broken: tuple[int, str] | None = None
    try:
        for number, line in numbered_lines(path, LONGEST_LINE):
            if broken:
                raise LogError(path, broken[1], line=broken[0])
            try:
                _collect(raw, number, line)
            except ValueError as error:
                broken = (number, str(error))
    except BROKEN as error:
        broken = broken or (number + 1, f"the gzip stream breaks off here ({str(error)[:60]})")
    if broken and not keep_partial:
        offer = f"; {KEEPS_THE_REST}" if broken[0] > 1 else ""
        raise LogError(path, f"{broken[1]}{offer}", line=broken[0])
    if broken:
        raw.notes.append(f"{path}:{broken[0]}: {broken[1]}; kept what came before")
    raw.notes += [f"skipped {count} {name} records" for name, count in sorted(raw.skipped.items())]
    return raw


def _collect(raw: RawLog, number: int, line: str) -> None:
    record = parse_record(line)
    if isinstance(record, OffsetRecord):
        raw.offsets[record.name] = record.offset_m
    elif isinstance(record, str):
        raw.skipped[record] += 1
    else:
        raw.take(record, number)
