"""Formats of surveyors, by packages that read them: E57 (pye57), LAS and LAZ (laspy, for LAZ with lazrs)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slam.errors import LogError, MissingPackageError
from slam.io.clouds.cloud import Cloud, checked
from slam.io.raw import check_ratio, check_room, damage_told, file_size, in_short, read_bytes
from spplanes._check import FloatArray

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")


def read_e57(path: Path) -> Cloud:
    """Read the one scan of an E57 file, in the scanner's frame, with its pose."""
    with _opened(path) as file:
        if file.scan_count != 1:
            raise LogError(path, f"expected one scan, got {file.scan_count}; map or slam take them all")
        return _scan(path, file, 0)


def read_e57_scans(path: Path) -> list[Cloud]:
    """Read all scans of an E57 file."""
    with _opened(path) as file:
        return [_scan(path, file, index) for index in range(file.scan_count)]


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
    if header.point_count > 8 * file_size(path):  # a bit a point is little: but constant columns take none
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
    """Points in their rows and columns; as they came where those say nothing, or fill less than a cell in 16."""
    rows, columns = int(row.max(initial=0)) + 1, int(column.max(initial=0)) + 1
    senseless = row.min(initial=0) < 0 or column.min(initial=0) < 0 or min(rows, columns) < 2
    if senseless or rows * columns > 16 * len(points):
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


def read_las(path: Path) -> Cloud:
    """Read the points of a LAS or LAZ file, scaled and with offset, in the file's frame."""
    try:
        import laspy
    except ImportError as error:
        raise MissingPackageError(path, "laspy", "las") from error
    _check_header(path)
    try:
        # not the parallel backend: it takes memory for whatever sizes of chunks a damaged file states
        with laspy.open(path, laz_backend=laspy.LazBackend.Lazrs) as reader:
            header = reader.header
            if header.are_points_compressed:
                _check_chunks(path, int(header.offset_to_point_data))
                check_ratio(path, header.point_count * header.point_format.size, file_size(path))
            # a compressed point takes a tenth of a byte at least: whoever declares more points declares nonsense
            least = 0.1 if header.are_points_compressed else header.point_format.size
            room = file_size(path) - int(header.offset_to_point_data)
            check_room(path, f"{header.point_count} points", int(header.point_count * least), room)
            found = reader.read()
            points = np.column_stack([np.asarray(axis, dtype=np.float64) for axis in (found.x, found.y, found.z)])
    except LogError:
        raise
    except BaseException as error:  # damage makes laspy raise errors of struct and numpy, and lazrs panic
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        if isinstance(error, laspy.errors.LaspyException) and "backend" in str(error).lower():
            raise MissingPackageError(path, "lazrs", "las") from error
        problem = f"expected a LAS or LAZ file, which this cannot be read as ({in_short(error)})"
        raise LogError(path, problem) from error
    if len(points) != header.point_count:
        raise LogError(path, f"expected {header.point_count} points, got {len(points)}")
    return checked(path, points.reshape(-1, 3))


def _check_header(path: Path) -> None:
    """Refuse records of variable length that the file cannot hold: to skip billions of them takes for ever.

    Without its content one takes 54 bytes before the points, and 60 after them.
    """
    head, size = read_bytes(path, size=375), file_size(path)
    if len(head) < 227 or head[:4] != b"LASF":
        raise LogError(path, "expected a LAS or LAZ file, got one that does not begin like one, or ends in its header")
    header_size, offset, count = struct.unpack_from("<HII", head, 94)
    check_room(path, "what is before the points", offset, size)
    check_room(path, f"{count} records before the points", count * 54, min(offset, size) - header_size)
    if head[25] >= 4 and len(head) >= 247:
        start, count = struct.unpack_from("<QI", head, 235)
        check_room(path, f"{count} records after the points", count * 60, max(size - start, 0))


def _check_chunks(path: Path, start: int) -> None:
    """Refuse more chunks of compressed points than there is room for: lazrs takes memory for all of them at once."""
    size = file_size(path)
    (table,) = struct.unpack("<q", read_bytes(path, start, 8).ljust(8, b"\0"))
    if table == -1:  # written to a stream: its place is at the end of the file
        (table,) = struct.unpack("<q", read_bytes(path, max(size - 8, 0), 8).ljust(8, b"\0"))
    check_room(path, "the table of chunks", table + 8 if table > 0 else size + 1, size)
    _, count = struct.unpack("<II", read_bytes(path, table, 8))
    check_room(path, f"{count} chunks of points", count * 20, size - start)  # each begins with a whole point
