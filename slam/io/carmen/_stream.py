"""A CARMEN log as a stream of lines, plain or gzip: a row of a table for each record, its ranges in a spool."""

from __future__ import annotations

import math
import struct
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam.errors import KEEPS_THE_REST, LogError
from slam.io.carmen._records import LaserRecord, OdomRecord, OffsetRecord, parse_record
from slam.io.packed import BROKEN, numbered_lines
from slam.io.spool import Spool
from spplanes._check import FloatArray

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
