"""One door for every format of clouds, by the ending of the name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slam.errors import LogError, check_cloud_given
from slam.io.clouds import pcd, ply
from slam.io.clouds.cloud import Cloud
from slam.io.clouds.depth import read_depth_image
from slam.io.clouds.plain import read_kitti_bin, read_npy, read_npz, read_text, weigh_kitti_bin, weigh_npy
from slam.io.clouds.survey import read_e57, read_las

_READERS: dict[str, Callable[[Path], Cloud]] = {
    ".pcd": pcd.read_pcd,
    ".ply": ply.read_ply,
    ".bin": read_kitti_bin,
    ".npy": read_npy,
    ".npz": read_npz,
    ".png": read_depth_image,
    ".las": read_las,
    ".laz": read_las,
    ".e57": read_e57,
    **dict.fromkeys((".xyz", ".txt", ".asc", ".csv", ".pts"), read_text),
}
#: What can be seen to be wrong without reading the points.
_WEIGHERS: dict[str, Callable[[Path], object]] = {
    ".pcd": pcd.read_header,
    ".ply": ply.read_header,
    ".bin": weigh_kitti_bin,
    ".npy": weigh_npy,
}
#: Endings of the files that `read_cloud` reads.
CLOUD_SUFFIXES = tuple(_READERS)


def is_cloud_file(path: Path) -> bool:
    """Whether the name is that of a cloud."""
    return path.suffix.lower() in _READERS


def weigh_cloud(path: Path) -> None:
    """Check header and size without reading the points, as far as the format has them, as `read_cloud` would."""
    weigher = _WEIGHERS.get(path.suffix.lower())
    if weigher is not None:
        weigher(path)


def read_cloud(path: Path | str) -> Cloud:
    """Read one cloud.

    Raises:
        LogError: one sentence with the file, and the line where there is one: no such file, an unknown ending, a header
            that is none, no x y z, data that are cut off, damaged, or more or fewer than declared (seen before memory
            is taken for them; pickled objects are never loaded), what is not a number, no point at all.
        MissingPackageError: the package that reads the format is not installed.
    """
    path = Path(path)
    check_cloud_given(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise LogError(path, f"expected a cloud ({', '.join(CLOUD_SUFFIXES)}), got the ending {path.suffix[:20]!r}")
    return reader(path)
