"""Reader of LAS and LAZ clouds (needs laspy, for LAZ with lazrs)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.io.clouds._files import check_room, file_size
from slam.io.clouds.cloud import Cloud, checked
from slam.io.log import LogError, MissingPackageError

#: A compressed point takes this many bytes at least: whoever declares more points than that declares nonsense.
_LEAST_BYTES = 0.02


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
    try:
        with laspy.open(path) as reader:
            header = reader.header
            least = _LEAST_BYTES if header.are_points_compressed else header.point_format.size
            room = file_size(path) - int(header.offset_to_point_data)
            check_room(path, f"{header.point_count} points", int(header.point_count * least), room)
            found = reader.read()
            points = np.column_stack([np.asarray(axis, dtype=np.float64) for axis in (found.x, found.y, found.z)])
    except LogError:
        raise
    except laspy.errors.LaspyException as error:
        if "backend" in str(error).lower():
            raise MissingPackageError(path, "lazrs", "las") from error
        raise LogError(path, f"expected a LAS or LAZ file, which this cannot be read as ({_short(error)})") from error
    except Exception as error:  # damage makes laspy raise errors of struct, numpy and its decompressors
        raise LogError(path, f"expected a LAS or LAZ file, which this cannot be read as ({_short(error)})") from error
    if len(points) != header.point_count:
        raise LogError(path, f"expected {header.point_count} points, got {len(points)}")
    return checked(path, points.reshape(-1, 3))


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:80] or type(error).__name__
