"""2D scans that wait on the disk until they are looked at: a log of hours need not fit into memory."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import Any

import numpy as np

from slam.errors import LogError
from slam.sensors.log import LaserScan, OdometryReading
from spplanes._check import FloatArray

#: So much of a log stays in memory, bytes; a longer one goes into the folder for temporary files (TMPDIR).
_IN_MEMORY_BYTES = 16 << 20


class Spool:
    """Numbers put away one after another, without a name, gone with the process whatever ends it."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self._file = SpooledTemporaryFile(max_size=_IN_MEMORY_BYTES, prefix="spplanes-")  # noqa: SIM115  # as long as its scans
        self._end = 0

    def put(self, numbers: FloatArray) -> int:
        """Put numbers, shape (N,), away; returns their place. Raises `LogError` where there is no room for them."""
        place, data = self._end, numbers.tobytes()
        try:
            self._file.seek(place)
            self._file.write(data)
            self._file.flush()  # all of it is in the file, wherever this process may fork
        except OSError as error:
            problem = f"expected room for its scans in the folder for temporary files: {error.strerror or error}"
            raise LogError(self._source, problem) from error
        self._end += len(data)
        return place

    def get(self, place: int, count: int) -> FloatArray:
        """The numbers at a place, shape (count,)."""
        if self._end > _IN_MEMORY_BYTES:  # in a file, whose position processes that were forked would share
            data = os.pread(self._file.fileno(), 8 * count, place)
        else:
            self._file.seek(place)
            data = self._file.read(8 * count)
        if len(data) != 8 * count:
            raise LogError(self._source, "expected its scans in the folder for temporary files, found them cut off")
        return np.frombuffer(data, dtype=np.float64).copy()


class StoredScan(LaserScan):
    """A 2D scan whose ranges, and pose if there is one, are read each time they are asked for."""

    def __new__(cls, *given: Any, **fields: Any) -> Any:
        """Of the fields of a scan, as `dataclasses.replace` gives them, one in memory."""
        return LaserScan(**fields) if "ranges" in fields else super().__new__(cls)

    def __init__(
        self,
        stamp_ns: int,
        sensor: str,
        angles: FloatArray,
        place: int,
        read: Callable[[int], FloatArray],
        pose: Callable[[int], FloatArray | None] | None = None,
    ) -> None:
        known = {"stamp_ns": stamp_ns, "sensor": sensor, "angles": angles}
        for name, value in {**known, "_place": place, "_read": read, "_pose": pose}.items():
            object.__setattr__(self, name, value)  # frozen: set once, here

    def loaded(self) -> LaserScan:
        """The scan with its ranges in memory."""
        return LaserScan(self.stamp_ns, self.sensor, self.ranges, self.angles, self.world_T_body)

    def __repr__(self) -> str:
        return f"StoredScan(stamp_ns={self.stamp_ns}, sensor={self.sensor!r})"  # without reading it

    @property
    def ranges(self) -> FloatArray:  # type: ignore[override]  # a field there, read each time here
        """Range per beam, shape (B,), m; NaN = no return."""
        return self._read(self._place)  # type: ignore[attr-defined]

    @property
    def world_T_body(self) -> FloatArray | None:  # type: ignore[override]
        """Pose of the robot that the record itself gives, shape (4, 4); None: it gives none."""
        return None if self._pose is None else self._pose(self._place)  # type: ignore[attr-defined]


class StoredReading(OdometryReading):
    """An odometry reading whose transform is made each time it is asked for."""

    def __new__(cls, *given: Any, **fields: Any) -> Any:
        """Of the fields of a reading, as `dataclasses.replace` gives them, one in memory."""
        return OdometryReading(**fields) if "odom_T_body" in fields else super().__new__(cls)

    def __init__(self, stamp_ns: int, place: int, pose: Callable[[int], FloatArray]) -> None:
        for name, value in {"stamp_ns": stamp_ns, "_place": place, "_pose": pose}.items():
            object.__setattr__(self, name, value)  # frozen: set once, here

    def __repr__(self) -> str:
        return f"StoredReading(stamp_ns={self.stamp_ns})"

    @property
    def odom_T_body(self) -> FloatArray:  # type: ignore[override]
        """Body in the odometry frame, shape (4, 4)."""
        return self._pose(self._place)  # type: ignore[attr-defined]


class SharedAngles:
    """Bearings that are the same scan after scan are kept once."""

    def __init__(self) -> None:
        self._known: dict[str, FloatArray] = {}

    def of(self, sensor: str, angles: FloatArray) -> FloatArray:
        """The angles, or those of the sensor's scan before if they are the same."""
        known = self._known.get(sensor)
        if known is None or known.shape != angles.shape or not np.array_equal(known, angles):
            known = self._known[sensor] = angles
        return known
