"""Clouds without a header of their own: text, a point a line; numpy's .npy and .npz; KITTI's .bin."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from slam.errors import LogError
from slam.io.clouds.cloud import Cloud, checked, points_of
from slam.io.raw import ascii_of, check_ratio, damage_told, file_size, read_bytes, text_rows

#: A point of KITTI: x, y, z and reflectance, bytes.
_KITTI_BYTES = 16
_UNREADABLE = "expected an array in numpy's format, got a file that cannot be read"


def read_npy(path: Path) -> Cloud:
    """Read points (N, 3) or (S, B, 3), further columns left out, or a structured array with x, y and z."""
    with damage_told(path, _UNREADABLE), path.open("rb") as stream:  # numpy's parser raises errors of Python's own too
        array = _array(path, stream, file_size(path))
    return _cloud(path, array)


def read_npz(path: Path) -> Cloud:
    """Read the array `points` or `xyz`, or the only one there is, as `read_npy` does."""
    with damage_told(path, _UNREADABLE), zipfile.ZipFile(path) as archive:
        member = _member(path, archive)
        check_ratio(path, member.file_size, member.compress_size)
        with archive.open(member) as stream:
            array = _array(path, stream, member.file_size)
    return _cloud(path, array)


def weigh_npy(path: Path) -> None:
    """Read the header alone."""
    with damage_told(path, _UNREADABLE), path.open("rb") as stream:
        _check_declared(path, stream, file_size(path))


def read_kitti_bin(path: Path) -> Cloud:
    """Read a KITTI cloud."""
    weigh_kitti_bin(path)
    return checked(path, points_of(path, *np.frombuffer(read_bytes(path), dtype="<f4").reshape(-1, 4).T[:3]))


def weigh_kitti_bin(path: Path) -> None:
    """Refuse a size that no number of points has."""
    size = file_size(path)
    if size % _KITTI_BYTES:
        raise LogError(path, f"expected {_KITTI_BYTES} bytes a point, got {size} bytes: cut off, or not of this format")


def _member(path: Path, archive: zipfile.ZipFile) -> zipfile.ZipInfo:
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    for name in ("points", "xyz"):
        if name in members:
            return members[name]
    if len(members) != 1:
        names = ascii(", ".join(members)[:60]) if members else "none"
        raise LogError(path, f"expected an array 'points' or only one array, got {names}")
    return next(iter(members.values()))


def _check_declared(path: Path, stream: IO[bytes], room: int) -> None:
    """Read the header alone and compare it with the bytes there are; the stream is set back to its start."""
    version = npy.read_magic(stream)
    read_header = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read_header(stream)
    if dtype.hasobject:
        raise LogError(path, "expected an array of numbers, got one of Python objects")
    declared = math.prod(shape) * dtype.itemsize
    if declared > room - stream.tell():
        raise LogError(path, f"expected {declared} bytes for an array of shape {shape}, got {room - stream.tell()}")
    stream.seek(0)


def _array(path: Path, stream: IO[bytes], room: int) -> np.ndarray:
    _check_declared(path, stream, room)
    return npy.read_array(stream, allow_pickle=False)


def _cloud(path: Path, array: np.ndarray) -> Cloud:
    if array.dtype.names is not None:
        if not {"x", "y", "z"} <= set(array.dtype.names):
            raise LogError(path, f"expected the fields x, y and z, got {', '.join(array.dtype.names)[:60]}")
        array = np.stack([array[axis] for axis in "xyz"], axis=-1)
    if array.dtype.kind not in "fiu":
        raise LogError(path, f"expected an array of real numbers, got one of {array.dtype}")
    if array.ndim not in (2, 3) or array.shape[-1] < 3:
        raise LogError(path, f"expected an array of shape (N, 3) or (S, B, 3), got {array.shape}")
    return checked(path, points_of(path, *(array[..., axis] for axis in range(3))))


def read_text(path: Path) -> Cloud:
    """Read rows of numbers separated by blanks, commas or semicolons; `nan` is no return.

    Lines that start with # or // before the first point are comments. A line of names before the first point says which
    columns are x, y and z; without one they are the first three. A line with one whole number is the count of .pts.
    """
    data = read_bytes(path).removeprefix(b"\xef\xbb\xbf")
    lines = data.split(b"\n")
    first, names, count = _head(lines)
    separator = next((sign for sign in (",", ";") if first < len(lines) and sign.encode() in lines[first]), None)
    text = ascii_of(path, b"\n".join(lines[first:]), first + 1)
    rows = text_rows(path, text, None, first + 1, separator)
    if not len(rows):
        raise LogError(path, "expected lines of numbers, got none")
    if count is not None and count != len(rows):
        raise LogError(path, f"expected the {count} points that the first line counts, got {len(rows)}")
    if rows.shape[1] < 3:
        raise LogError(path, f"expected x y z in every line, got {rows.shape[1]} columns", line=first + 1)
    axes = [names.index(axis) for axis in "xyz"] if {"x", "y", "z"} <= set(names) else [0, 1, 2]
    if max(axes) >= rows.shape[1]:
        raise LogError(path, f"expected as many columns as names, got {rows.shape[1]}", line=first + 1)
    return checked(path, rows[:, axes])


def _head(lines: list[bytes]) -> tuple[int, list[str], int | None]:
    """Index of the first point's line, names of the columns, and the count of points, where they are given."""
    names: list[str] = []
    count: int | None = None
    for index, raw in enumerate(lines):
        text = raw.strip()
        if not text:
            continue
        bare = text.lstrip(b"#/ ").translate(bytes.maketrans(b",;", b"  "))
        words = bare.decode("ascii", errors="replace").lower().split()
        if text.startswith((b"#", b"//")):
            names = words if {"x", "y", "z"} <= set(words) else names
        elif not names and {"x", "y", "z"} <= set(words):
            names = words
        elif count is None and len(words) == 1 and words[0].isdecimal() and len(words[0]) < 19:
            count = int(words[0])
        else:
            return index, names, count
    return len(lines), names, count
