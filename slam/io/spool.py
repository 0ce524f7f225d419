"""2D scans that wait on the disk until they are looked at: a log of hours need not fit into memory."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import SpooledTemporaryFile

import numpy as np

from slam.errors import LogError
from slam.lazy import Stored
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


class StoredScan(Stored, LaserScan):
    """A 2D scan whose ranges, and pose if there is one, are read each time they are asked for."""


class StoredReading(Stored, OdometryReading):
    """An odometry reading whose transform is made each time it is asked for."""
