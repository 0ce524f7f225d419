"""Reader of KITTI's .bin clouds: x, y, z, intensity as four little-endian 32-bit floats a point, nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.io.clouds._files import check_byte_order, read_bytes
from slam.io.clouds.cloud import Cloud, checked
from slam.io.log import LogError

_BYTES = 16


def read_kitti_bin(path: Path) -> Cloud:
    """Read a KITTI cloud.

    Raises:
        LogError: a size that is not a multiple of 16 bytes, numbers that are no coordinates, no point at all.
    """
    data = read_bytes(path)
    if len(data) % _BYTES:
        raise LogError(path, f"expected {_BYTES} bytes a point, got {len(data)} bytes: cut off, or not of this format")
    points = np.frombuffer(data, dtype="<f4").reshape(-1, 4)[:, :3].astype(np.float64)
    check_byte_order(path, points)
    return checked(path, points)
