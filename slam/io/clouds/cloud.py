"""What every reader of clouds returns, and how it comes to it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slam.errors import LogError
from slam.io.raw import ascii_of, read_bytes, text_rows
from spplanes._check import FloatArray
from spplanes.clouds.arrange import Grid

if TYPE_CHECKING:
    from slam.sensors.rig import Sensor

#: A header may be this long, bytes.
LONGEST_HEADER = 1 << 16
#: What a file says lies farther away was never seen, m.
FARTHEST_M = 1e9


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points as one sensor saw them from one place, or a cloud of any other origin."""

    points: FloatArray
    """Organised, shape (S, B, 3), or in the order of the file, shape (N, 3), in the sensor's frame, m; NaN = no return.
    """
    world_T_sensor: FloatArray | None = None
    """Where the file says the sensor was, shape (4, 4); None: it does not."""

    is_depth_image: bool = False
    """Whether z is the depth of a camera, whose noise grows with it."""


@dataclass(frozen=True, eq=False)
class Table:
    """Where a file has its points: rows of numbers, of which x, y and z are read."""

    dtype: np.dtype
    """One packed row, with x, y and z."""
    columns: list[int]
    """Which words of a line are x, y and z."""
    words: int
    """Of a line."""
    count: int
    """Of rows."""
    start: int
    """Where they begin, bytes."""
    line: int
    """Number of the line there."""

    def unpacked(self, path: Path) -> FloatArray:
        """Points (N, 3) of a binary file, m."""
        rows = np.frombuffer(read_bytes(path, self.start), dtype=self.dtype, count=self.count)
        return points_of(path, *(rows[axis] for axis in "xyz"))

    def parsed(self, path: Path, text: bytes, what: str) -> FloatArray:
        """Points (N, 3) of the lines of a text, m; a `LogError` says of what there are more or fewer than declared."""
        rows = text_rows(path, ascii_of(path, text, self.line), self.words, self.line)
        if len(rows) != self.count:
            raise LogError(path, f"expected {self.count} {what}, got {len(rows)} lines")
        return rows[:, self.columns]


def header_lines(path: Path) -> Iterator[tuple[int, int, list[str]]]:
    """Of every line of a header that may be one: its number, where it ends, bytes, and its words."""
    end = 0
    for number, line in enumerate(read_bytes(path, size=LONGEST_HEADER).split(b"\n"), start=1):
        end += len(line) + 1
        yield number, end, line.decode("ascii", errors="replace").split()


def checked(path: Path, points: FloatArray, world_T_sensor: FloatArray | None = None) -> Cloud:
    """A cloud with NaN for every point that is no place; a `LogError` where no return is left."""
    finite = np.asarray((np.abs(points) < FARTHEST_M).all(axis=-1))
    if not finite.any():
        raise LogError(path, "expected at least one point, got none" + (" that is finite" if finite.size else ""))
    if not finite.all():
        points = np.where(finite[..., None], points, np.nan)
    return Cloud(np.ascontiguousarray(points, dtype=np.float64), world_T_sensor)


def points_of(path: Path, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> FloatArray:
    """Coordinates (...) of a binary file as points, shape (..., 3), m.

    A LogError where many are such as no sensor gives: floats read in the wrong order of their bytes.
    """
    points = np.stack((x, y, z), axis=-1).astype(np.float64)
    size = np.abs(points[np.isfinite(points) & (points != 0.0)])
    if np.count_nonzero((size < 1e-20) | (size > FARTHEST_M)) > 0.25 * size.size:
        raise LogError(path, "expected coordinates in metres, got numbers as of another byte order or type")
    return points


def grid_of(sensor: Sensor) -> Grid | None:
    """The range image that a rig states for a sensor."""
    return None if sensor.rows is None or sensor.columns is None else Grid(sensor.rows, sensor.columns)
