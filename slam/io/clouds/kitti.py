"""Reader of KITTI's .bin clouds: x, y, z, intensity as four little-endian 32-bit floats a point, nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.io.clouds._files import check_byte_order, file_size, read_bytes
from slam.io.clouds.cloud import Cloud, checked

_BYTES = 16


def read_kitti_bin(path: Path) -> Cloud:
    """Read a KITTI cloud.

    Raises:
        LogError: a size that is not a multiple of 16 bytes, numbers that are no coordinates, no point at all.
    """
    weigh_kitti_bin(path)
    points = np.frombuffer(read_bytes(path), dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    check_byte_order(path, points)
    return checked(path, points)


def weigh_kitti_bin(path: Path) -> None:
    """Refuse a size that no number of points has."""
    size = file_size(path)
    if size % _BYTES:
        raise LogError(path, f"expected {_BYTES} bytes a point, got {size} bytes: cut off, or not of this format")
