"""A CARMEN log as a stream of lines, plain or gzip, to the records in it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from slam.io._carmen_records import LaserRecord, OdomRecord, OffsetRecord, parse_record
from slam.io.log import LogError
from slam.io.packed import BROKEN, numbered_lines

#: Longer lines are refused before they fill the memory, bytes.
LONGEST_LINE = 1 << 20


@dataclass
class RawLog:
    """Everything read so far, in the order of the file."""

    records: list[LaserRecord | OdomRecord] = field(default_factory=list)
    """Records of lasers and odometry."""
    lines: list[int] = field(default_factory=list)
    """Line number of each record."""
    offsets: dict[str, float] = field(default_factory=dict)
    """Stated offset along the robot's axis by record name, m."""
    skipped: Counter[str] = field(default_factory=Counter)
    """How many records of other kinds there were, by keyword."""
    notes: list[str] = field(default_factory=list)
    """What was skipped or repaired, one sentence each."""


def read_records(path: Path, keep_partial: bool) -> RawLog:
    """Read all records; a stream or a last line that breaks off is an error, or a note with `keep_partial`."""
    raw, number = RawLog(), 0
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
        raise LogError(path, broken[1], line=broken[0])
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
        raw.records.append(record)
        raw.lines.append(number)
