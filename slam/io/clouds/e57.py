"""Reader of E57 files: one or more scans with their poses, organised where rows and columns are told (needs pye57)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slam.errors import LogError, MissingPackageError
from slam.io.clouds.cloud import Cloud, checked
from slam.io.packed import damage_told, file_size, read_bytes
from spplanes._check import FloatArray

#: Bits that a point of an E57 file takes at least; constant columns take none, so this is generous.
_LEAST_BITS = 1
#: A grid of rows and columns may have this many cells for each point.
_MOST_CELLS_PER_POINT = 16
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")


def read_e57(path: Path, index: int | None = None) -> Cloud:
    """Read one scan of an E57 file, in the scanner's frame, with its pose.

    Args:
        path: the file.
        index: which scan; None: the only one.

    Raises:
        LogError: no E57 file, several scans and none asked for, more points declared than it can hold, damage.
        MissingPackageError: pye57 is not installed.
    """
    count = count_e57(path)
    if index is None and count != 1:
        raise LogError(path, f"expected one scan, got {count}; map or slam take them all")
    with _opened(path) as file:
        return _scan(path, file, index or 0)


def count_e57(path: Path) -> int:
    """Number of scans in a file."""
    with _opened(path) as file:
        return int(file.scan_count)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    try:
        import pye57
    except ImportError as error:
        raise MissingPackageError(path, "pye57", "e57") from error
    if read_bytes(path, size=8) != b"ASTM-E57":
        raise LogError(path, "expected an E57 file, got one that does not begin like one")
    with damage_told(path, "expected a whole E57 file, got one that cannot be read"):
        pye57.libe57.ImageFile(str(path), "r").close()  # E57 itself would meddle with a file it cannot open
        with pye57.E57(str(path)) as file:
            yield file


def _scan(path: Path, file: Any, index: int) -> Cloud:
    header = file.get_header(index)
    if header.point_count * _LEAST_BITS > 8 * file_size(path):
        raise LogError(path, f"expected as many points as the file can hold, got {header.point_count} declared")
    told = set(header.point_fields)
    axes = _CARTESIAN if set(_CARTESIAN) <= told else _SPHERICAL
    if not set(axes) <= told:
        raise LogError(path, f"expected cartesian or spherical points, got the fields {', '.join(sorted(told))[:60]}")
    wanted = [*axes, *(name for name in (*_INVALID, "rowIndex", "columnIndex") if name in told)]
    data, buffers = file.make_buffers(wanted, header.point_count)
    header.points.reader(buffers).read()
    points = np.column_stack([data[name] for name in axes]).astype(np.float64)
    if axes is _SPHERICAL:
        distance, azimuth, elevation = points.T
        level = distance * np.cos(elevation)
        points = np.column_stack((level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)))
    for name in _INVALID:
        if name in data:
            points[data[name] != 0] = np.nan
    if {"rowIndex", "columnIndex"} <= told:
        points = _organised(points, data["rowIndex"], data["columnIndex"])
    return checked(path, points, _pose(header) if header.has_pose() else None)


def _organised(points: FloatArray, row: np.ndarray, column: np.ndarray) -> FloatArray:
    """Points in their rows and columns; as they came where those say nothing, or the grid would be nearly empty."""
    rows, columns = int(row.max(initial=0)) + 1, int(column.max(initial=0)) + 1
    senseless = row.min(initial=0) < 0 or column.min(initial=0) < 0 or min(rows, columns) < 2
    if senseless or rows * columns > _MOST_CELLS_PER_POINT * len(points):
        return points
    grid = np.full((rows, columns, 3), np.nan)
    grid[row, column] = points
    return grid


def _pose(header: Any) -> FloatArray | None:
    """world_T_scanner; None for the identity."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(np.asarray(header.rotation, dtype=np.float64), scalar_first=True).as_matrix()
    pose[:3, 3] = np.asarray(header.translation, dtype=np.float64)
    return None if np.array_equal(pose, np.eye(4)) else pose
