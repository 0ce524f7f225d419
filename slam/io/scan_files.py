"""Scans in files of a folder, one a file, and the poses beside them."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory, nearest_stamp, read_tum
from slam.sensors.log import Event, Log, OdometryReading, StoredCloud
from spplanes._check import FloatArray

#: A pose belongs to a scan, and odometry reaches it, where it is at most this far in time, ns.
_REACH_NS = 500_000_000


@dataclass(frozen=True)
class ScanFiles:
    """The scans of a folder, in order; a `LogError` where their times do not ascend."""

    folder: Path
    kind: str
    """What each is, for sentences: cloud or image."""
    paths: list[Path]
    stamps: list[int]
    """Their times, ns."""
    timed: bool
    """Whether somebody told the times."""
    numbered: bool = True
    """Whether the numbers in the names say which of more rows belong to them."""

    def __post_init__(self) -> None:
        if any(later <= earlier for earlier, later in pairwise(self.stamps)):
            problem = f"expected times of the {self.kind}s that ascend, got one that repeats or runs backwards"
            raise LogError(self.folder, problem)

    def poses(self, source: Path, rows: Trajectory | FloatArray) -> FloatArray:
        """The pose at every scan, shape (N, 4, 4): by the times where both have them, else as `in_order`."""
        if not (isinstance(rows, Trajectory) and self.timed):
            return self.in_order(source, rows)
        gaps = np.abs(rows.stamps_ns[nearest_stamp(self.stamps, rows.stamps_ns)] - self.stamps)
        for alone in np.flatnonzero(gaps > _REACH_NS)[:1]:
            problem = f"expected a pose within {_REACH_NS / 1e9} s of the {self.kind}'s time, found none"
            raise LogError(self.paths[alone], problem)
        return rows.poses_at(self.stamps)

    def in_order(self, source: Path, rows: Trajectory | FloatArray) -> FloatArray:
        """The pose of every scan from as many rows, or, of more, by the number in its name, shape (N, 4, 4)."""
        poses = rows.poses if isinstance(rows, Trajectory) else rows
        if len(poses) == len(self.paths):
            return poses
        numbers = [int(words[-1]) if (words := re.findall(r"\d+", path.stem)) else len(poses) for path in self.paths]
        if self.numbered and len(poses) > len(self.paths) and max(numbers) < len(poses):
            return poses[numbers]
        raise LogError(source, f"expected a pose for each of the {len(self.paths)} {self.kind}s, got {len(poses)}")

    def events(self, sensor: str, poses: FloatArray | None, **readers: Callable[[Path], Any]) -> list[Event]:
        """The scans with world_T_body (N, 4, 4) or none; fields that have readers stay in the files until asked for."""
        told = zip(self.stamps, [None] * len(self.paths) if poses is None else poses, strict=True)
        of_place = {name: partial(self._read, read) for name, read in readers.items()}
        return [
            StoredCloud({"stamp_ns": stamp, "sensor": sensor, "world_T_body": pose}, of_place, place)
            for place, (stamp, pose) in enumerate(told)
        ]

    def _read(self, read: Callable[[Path], Any], place: int) -> Any:
        return read(self.paths[place])


def first_file(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first file of some names that is in a folder."""
    return next((folder / name for name in names if (folder / name).is_file()), None)


def with_odometry(log: Log, path: Path, body_T_sensor: FloatArray | None = None) -> Log:
    """The log with the poses of a TUM file, odom_T_body, for odometry; its own is left out, and a note says so.

    Where the file tells the poses of a sensor, `body_T_sensor` (4, 4) is its mount. A file that does not reach all
    scans is refused: where odometry is missing it would seem to say that the robot stood.
    """
    scans = log.scans()
    readings = readings_of(path, scans, body_T_sensor)
    note = taken_from(path, len(readings), len(log.events) - len(scans))
    return replace(log, events=in_order([*readings, *scans]), notes=[*log.notes, note], odometry_source=path)


def readings_of(path: Path, scans: Iterable[Event], body_T_sensor: FloatArray | None = None) -> list[OdometryReading]:
    """The readings of a TUM file for some scans, as in `with_odometry`."""
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
    outside = (stamps < rows.stamps_ns[0] - _REACH_NS) | (stamps > rows.stamps_ns[-1] + _REACH_NS)
    if outside.any():
        first, last = rows.stamps_ns[[0, -1]] * 1e-9
        raise LogError(
            path,
            f"expected odometry at the times of all {len(stamps)} scans, got it from {first:.3f} to {last:.3f} s, "
            f"beyond which {int(outside.sum())} lie, the first at {stamps[outside][0] * 1e-9:.3f} s",
        )
