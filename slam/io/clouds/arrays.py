"""Reader of numpy's files: .npy, and .npz with an array `points` or only one."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from slam.errors import LogError
from slam.io.clouds._files import check_byte_order, file_size
from slam.io.clouds.cloud import Cloud, checked
from slam.io.packed import check_ratio
from spplanes._check import FloatArray

_POINTS = ("points", "xyz")


def read_npy(path: Path) -> Cloud:
    """Read points (N, 3) or (S, B, 3), further columns left out, or a structured array with x, y and z.

    Raises:
        LogError: not such a file, an array of another shape or type (pickled objects are never loaded), more declared
            than the file holds, no point at all.
    """

    def load() -> np.ndarray:
        with path.open("rb") as stream:
            _check_declared(path, stream, file_size(path))
            return npy.read_array(stream, allow_pickle=False)

    return _cloud(path, _guarded(path, load))


def read_npz(path: Path) -> Cloud:
    """Read the array `points` or `xyz`, or the only one there is, as `read_npy` does.

    Raises:
        LogError: as `read_npy`; several arrays of other names; a member that grows out of all proportion.
    """

    def load() -> np.ndarray:
        with zipfile.ZipFile(path) as archive:
            member = _member(path, archive)
            check_ratio(path, member.file_size, member.compress_size)
            with archive.open(member) as stream:
                _check_declared(path, stream, member.file_size)
            with archive.open(member) as stream:
                return npy.read_array(stream, allow_pickle=False)

    return _cloud(path, _guarded(path, load))


def weigh_npy(path: Path) -> None:
    """Read the header alone."""

    def weigh() -> np.ndarray:
        with path.open("rb") as stream:
            _check_declared(path, stream, file_size(path))
        return np.empty(0)

    _guarded(path, weigh)


def _guarded(path: Path, load: Callable[[], np.ndarray]) -> np.ndarray:
    try:
        return load()
    except LogError:
        raise
    except Exception as error:  # damaged headers make numpy's parser raise errors of the Python tokenizer, among others
        problem = getattr(error, "strerror", None) or " ".join(str(error).split())[:80]
        raise LogError(
            path, f"expected an array in numpy's format, got a file that cannot be read ({problem})"
        ) from error


def _member(path: Path, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    for name in _POINTS:
        if name in members:
            return members[name]
    if len(members) != 1:
        names = ascii(", ".join(members)[:60]) if members else "none"
        raise LogError(path, f"expected an array 'points' or only one array, got {names}")
    return next(iter(members.values()))


def _check_declared(path: Path, stream: IO[bytes], room: int) -> None:
    """Read the header alone and compare it with the bytes there are; the stream is left after it, then set back."""
    version = npy.read_magic(stream)
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    if dtype.hasobject:
        raise LogError(path, "expected an array of numbers, got one of Python objects")
    declared = math.prod(shape) * dtype.itemsize
    if declared > room - stream.tell():
        raise LogError(path, f"expected {declared} bytes for an array of shape {shape}, got {room - stream.tell()}")
    if stream.seekable():
        stream.seek(0)


def _cloud(path: Path, array: np.ndarray) -> Cloud:
    if array.dtype.names is not None:
        if not {"x", "y", "z"} <= set(array.dtype.names):
            raise LogError(path, f"expected the fields x, y and z, got {', '.join(array.dtype.names)[:60]}")
        array = np.stack([array[axis] for axis in "xyz"], axis=-1)
    if array.dtype.kind not in "fiu":
        raise LogError(path, f"expected an array of real numbers, got one of {array.dtype}")
    if array.ndim not in (2, 3) or array.shape[-1] < 3:
        raise LogError(path, f"expected an array of shape (N, 3) or (S, B, 3), got {array.shape}")
    points: FloatArray = array[..., :3].astype(np.float64)
    check_byte_order(path, points)
    return checked(path, points)
