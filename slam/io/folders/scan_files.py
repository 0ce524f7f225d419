"""Scans in files of a folder, one a file, and the poses beside them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.io.trajectories import Trajectory
from slam.sensors.log import Event, StoredCloud
from spplanes._check import FloatArray

#: A pose belongs to a scan where it is at most this far in time, or where two poses this close lie around it, ns.
POSE_GAP_NS = 500_000_000


@dataclass(frozen=True)
class ScanFiles:
    """The scans of a folder, in order; a `LogError` where their times do not ascend."""

    folder: Path
    """Where they are."""
    kind: str
    """What each is, for sentences: cloud or image."""
    paths: list[Path]
    """A file a scan."""
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
        for path, stamp in zip(self.paths, self.stamps, strict=True):
            after = int(np.searchsorted(rows.stamps_ns, stamp))
            near = rows.stamps_ns[max(after - 1, 0) : after + 1]
            if np.abs(near - stamp).min() > POSE_GAP_NS:
                problem = f"expected a pose within {POSE_GAP_NS / 1e9} s of the {self.kind}'s time, found none"
                raise LogError(path, problem)
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

    def events(self, sensor: str, read: Callable[[Path], FloatArray], poses: FloatArray | None) -> list[Event]:
        """The scans, which stay in their files until they are asked for, with world_T_body (N, 4, 4) or none."""
        told = [None] * len(self.paths) if poses is None else poses
        scans = zip(self.paths, self.stamps, told, strict=True)
        return [StoredCloud(stamp, sensor, partial(read, path), pose) for path, stamp, pose in scans]


def first_file(folder: Path, names: tuple[str, ...]) -> Path | None:
    """The first file of some names that is in a folder."""
    return next((folder / name for name in names if (folder / name).is_file()), None)
