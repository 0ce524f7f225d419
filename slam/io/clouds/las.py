"""Reader of LAS and LAZ clouds (needs laspy, for LAZ with lazrs)."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from slam.errors import LogError, MissingPackageError
from slam.io.clouds.cloud import Cloud, checked
from slam.io.packed import check_ratio, check_room, file_size, in_short, read_bytes

#: Bytes of a record of variable length without its content: before the points, and after them.
_RECORD_BYTES, _LATE_RECORD_BYTES = 54, 60
#: A chunk of compressed points begins with a whole one.
_CHUNK_BYTES = 20
#: A compressed point takes this many bytes at least: whoever declares more points than that declares nonsense.
_LEAST_BYTES = 0.1


def read_las(path: Path) -> Cloud:
    """Read the points of a LAS or LAZ file, scaled and with offset, in the file's frame.

    Raises:
        LogError: no such file, more points declared than it can hold (seen before memory is taken for them), damage.
        MissingPackageError: laspy, or lazrs for LAZ, is not installed.
    """
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
            least = _LEAST_BYTES if header.are_points_compressed else header.point_format.size
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
    """Refuse records of variable length that the file cannot hold: to skip billions of them takes for ever."""
    head, size = read_bytes(path, size=375), file_size(path)
    if len(head) < 227 or head[:4] != b"LASF":
        raise LogError(path, "expected a LAS or LAZ file, got one that does not begin like one, or ends in its header")
    header_size, offset, count = struct.unpack_from("<HII", head, 94)
    check_room(path, "what is before the points", offset, size)
    check_room(path, f"{count} records before the points", count * _RECORD_BYTES, min(offset, size) - header_size)
    if head[25] >= 4 and len(head) >= 247:
        start, count = struct.unpack_from("<QI", head, 235)
        check_room(path, f"{count} records after the points", count * _LATE_RECORD_BYTES, max(size - start, 0))


def _check_chunks(path: Path, start: int) -> None:
    """Refuse more chunks of compressed points than there is room for: lazrs takes memory for all of them at once."""
    size = file_size(path)
    (table,) = struct.unpack("<q", read_bytes(path, start, 8).ljust(8, b"\0"))
    if table == -1:  # written to a stream: its place is at the end of the file
        (table,) = struct.unpack("<q", read_bytes(path, max(size - 8, 0), 8).ljust(8, b"\0"))
    check_room(path, "the table of chunks", table + 8 if table > 0 else size + 1, size)
    _, count = struct.unpack("<II", read_bytes(path, table, 8))
    check_room(path, f"{count} chunks of points", count * _CHUNK_BYTES, size - start)
