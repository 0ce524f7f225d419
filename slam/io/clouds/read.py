"""One door for every format of clouds, by the ending of the name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slam.io.clouds.arrays import read_npy, read_npz
from slam.io.clouds.cloud import Cloud
from slam.io.clouds.kitti import read_kitti_bin
from slam.io.clouds.pcd import read_pcd
from slam.io.clouds.ply import read_ply
from slam.io.clouds.text import read_text
from slam.io.log import LogError

_READERS: dict[str, Callable[[Path], Cloud]] = {
    ".pcd": read_pcd,
    ".ply": read_ply,
    ".bin": read_kitti_bin,
    ".npy": read_npy,
    ".npz": read_npz,
    **dict.fromkeys((".xyz", ".txt", ".asc", ".csv", ".pts"), read_text),
}
#: Endings of the files that `read_cloud` reads.
CLOUD_SUFFIXES = tuple(_READERS)


def is_cloud_file(path: Path) -> bool:
    """Whether the name is that of a cloud."""
    return path.suffix.lower() in _READERS


def read_cloud(path: Path | str) -> Cloud:
    """Read one cloud.

    Raises:
        LogError: no such file, an unknown ending, or what the reader of its format says.
    """
    path = Path(path)
    if not path.is_file():
        raise LogError(path, "expected a file with a cloud, found none")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise LogError(path, f"expected a cloud ({', '.join(CLOUD_SUFFIXES)}), got the ending {path.suffix[:20]!r}")
    return reader(path)
