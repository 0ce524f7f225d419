"""Lines of a CARMEN log as a table of records: counts, numbers and times checked, nothing interpreted yet."""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.errors import KEEPS_THE_REST, LogError
from slam.io.raw import BROKEN, nanoseconds, number_of, numbered_lines
from slam.lazy import Spool
from spplanes._check import FloatArray

#: The words after the poses of every record: time of the sensor, host, time of the logger.
_TAIL = 3
_NUMBERED = re.compile(r"(?:ROBOT|RAW)LASER\d$")
_KEYWORD = re.compile(r"[A-Z][A-Z0-9_]*$")
#: Laser offsets along the robot's axis that a log may state.
OFFSET_PARAMETERS = {"robot_frontlaser_offset": "FLASER", "robot_rearlaser_offset": "RLASER"}
#: A record without its ranges: NaN stands for what it does not tell. `stamps_ns`: of the sensor and of the logger;
#: `place`: of its ranges in the spool; `largest`: of its finite ranges, m; poses: x, y, theta, the robot's for FLASER
#: and RLASER its odometry.
ROW = np.dtype(
    [("stamps_ns", "<i8", 2), *((name, "<i8") for name in ("line", "name", "beams", "place"))]
    + [(name, "<f8") for name in ("start", "step", "range_max_m", "largest")]
    + [("laser_pose", "<f8", 3), ("robot_pose", "<f8", 3)]
)
_PACK = struct.Struct("<6q10d").pack
_NOT_TOLD: tuple[float, ...] = (math.nan,) * 3
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

    def take(self, line: str, number: int) -> None:
        """Keep what is told by a line, neither empty nor a comment; a ValueError says what is wrong with it."""
        words = line.split()
        keyword, ranges = words[0], None
        scale, laser_pose, robot_pose = _NOT_TOLD, _NOT_TOLD, _NOT_TOLD
        if keyword == ODOM:  # x y theta tv rv acceleration, t host t
            _check_length(words, 1 + 6 + _TAIL)
            robot_pose = _pose(words, 1)
        elif keyword in ("FLASER", "RLASER"):  # n r... x y theta odom_x odom_y odom_theta, t host t
            n = _count(words, 1)
            _check_length(words, 2 + n + 6 + _TAIL)
            ranges, laser_pose, robot_pose = _numbers(words[2 : 2 + n]), _pose(words, 2 + n), _pose(words, 5 + n)
        elif _NUMBERED.match(
            keyword
        ):  # type start fov step max accuracy mode n r... m e... (2 poses, 5 more), t host t
            n = _count(words, 8)
            m = _count(words, 9 + n) if len(words) > 9 + n else 0
            has_pose, tail = keyword.startswith("ROBOT"), 10 + n + m
            _check_length(words, tail + (11 if has_pose else 0) + _TAIL)
            start, _, step, range_max = _numbers(words[2:6]).tolist()
            if not (math.isfinite(start) and math.isfinite(step) and step > 0.0):
                raise ValueError(f"expected a finite start angle and a positive step, got {words[2]} and {words[4]}")
            ranges, scale = _numbers(words[9 : 9 + n]), (start, step, range_max if range_max > 0.0 else math.nan)
            if has_pose:
                laser_pose, robot_pose = _pose(words, tail), _pose(words, tail + 3)
        elif keyword == "PARAM" and len(words) > 2 and words[1] in OFFSET_PARAMETERS:
            self.offsets[OFFSET_PARAMETERS[words[1]]] = float(_numbers(words[2:3])[0])
            return
        elif _KEYWORD.match(keyword):
            self.skipped[keyword] += 1
            return
        else:
            raise ValueError(f"expected a CARMEN record, got {keyword[:20]!r}")
        stamps = nanoseconds(words[-3]), nanoseconds(words[-1])
        beams, place, largest = 0, 0, math.nan
        if ranges is not None:
            largest = float(np.max(ranges, initial=0.0, where=np.isfinite(ranges)))
            beams, place = ranges.size, self.spool.put(ranges)
        name = self.names.setdefault(keyword, len(self.names))
        self.packed += _PACK(*stamps, number, name, beams, place, *scale, largest, *laser_pose, *robot_pose)


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
    except ValueError:  # the first that is none is named
        return np.array([number_of(word) for word in words])


def _pose(words: list[str], place: int) -> tuple[float, ...]:
    pose = _numbers(words[place : place + 3])
    if not np.isfinite(pose).all():
        raise ValueError(f"expected a finite pose, got {' '.join(words[place : place + 3])}")
    return tuple(pose.tolist())


def read_records(path: Path, keep_partial: bool) -> RawLog:
    """Read all records; a stream or a last line that breaks off is an error, or a note with `keep_partial`."""
    raw, number = RawLog(Spool(path)), 0
    broken: LogError | None = None
    try:
        for number, line in numbered_lines(path, longest=1 << 20):
            if broken:  # in the middle
                raise broken
            try:
                raw.take(line, number)
            except ValueError as error:
                broken = LogError(path, str(error), line=number)
    except BROKEN as error:
        broken = broken or LogError(path, f"the gzip stream breaks off here ({str(error)[:60]})", line=number + 1)
    if broken and not keep_partial:
        offer = f"; {KEEPS_THE_REST}" if broken.line and broken.line > 1 else ""
        raise LogError(path, f"{broken.problem}{offer}", line=broken.line)
    if broken:
        raw.notes.append(f"{broken}; kept what came before")
    raw.notes += [f"skipped {count} {name} records" for name, count in sorted(raw.skipped.items())]
    return raw
