"""PCD (Point Cloud Library): reader of ascii, binary and binary_compressed in any order of fields, writer of binary."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import poses_of
from slam.io.clouds.cloud import LONGEST_HEADER, Cloud, Table, checked, header_lines, points_of
from slam.io.raw import check_room, file_size, number_of, read_bytes
from spplanes._check import FloatArray, as_shape
from spplanes._jit import njit

_TYPES = {"F4": "<f4", "F8": "<f8"} | {f"{kind}{n}": f"<{kind.lower()}{n}" for kind in "IU" for n in (1, 2, 4, 8)}
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


class Header(NamedTuple):
    """What a PCD file says about itself."""

    table: Table
    height: int
    """Rows of the image that they are; 1: not organised."""
    world_T_sensor: FloatArray | None
    """VIEWPOINT, the sensor in the frame of the points, shape (4, 4); None for the identity."""
    data: str
    """ascii, binary or binary_compressed."""


def read_pcd(path: Path) -> Cloud:
    """Read a PCD file; other fields than x, y and z are left out.

    A VIEWPOINT that is not the identity is where the sensor was in the frame of the points: the points go into the
    sensor's frame and it becomes `world_T_sensor`.
    """
    table, height, pose, data = read_header(path)
    if data == "binary":
        points = table.unpacked(path)
    elif data == "ascii":
        points = table.parsed(path, read_bytes(path, table.start), "points")
    else:  # field after field: all x, then all y and so on
        kind, count = table.dtype, table.count
        columns = _unpacked(path, read_bytes(path, table.start), count * kind.itemsize)
        fields = [(kind[axis], kind.fields[axis][1]) for axis in "xyz"]  # type: ignore[index]  # it has them
        points = points_of(path, *(np.frombuffer(columns, field, count, count * offset) for field, offset in fields))
    if height > 1:
        points = points.reshape(height, -1, 3)
    if pose is None:
        return checked(path, points)
    return checked(path, (points - pose[:3, 3]) @ pose[:3, :3], pose)


def read_header(path: Path) -> Header:
    """Read and check the header; the data are only weighed."""
    entries, start, line = _entries(path)
    fields = _required(path, entries, "FIELDS")
    counts = _whole(path, entries, "COUNT", len(fields)) if "COUNT" in entries else [1] * len(fields)
    sizes, types = _whole(path, entries, "SIZE", len(fields)), _required(path, entries, "TYPE")
    if len(types) != len(fields):
        raise LogError(path, f"expected {len(fields)} entries in TYPE, got {len(types)}")
    dtype = _dtype(path, fields, sizes, types, counts)
    columns = [sum(counts[: fields.index(axis)]) for axis in "xyz"]
    (width,), (height,) = _whole(path, entries, "WIDTH", 1), _whole(path, entries, "HEIGHT", 1)
    pose = _viewpoint(path, entries.get("VIEWPOINT", ["0", "0", "0", "1", "0", "0", "0"]))
    data, count = _required(path, entries, "DATA")[0].lower(), width * height
    declared = _whole(path, entries, "POINTS", 1)[0] if "POINTS" in entries else count
    if declared != count:
        raise LogError(path, f"expected WIDTH x HEIGHT = {count} points, got POINTS {declared}")
    if data not in ("ascii", "binary", "binary_compressed"):
        raise LogError(path, f"expected DATA ascii, binary or binary_compressed, got {data[:20]!r}")
    least = {"ascii": 2 * sum(counts), "binary": dtype.itemsize}.get(data)
    if least is not None:  # the last line of a text needs no end
        check_room(path, f"{count} points", count * least - (data == "ascii"), file_size(path) - start)
    return Header(Table(dtype, columns, sum(counts), count, start, line), height, pose, data)


def _entries(path: Path) -> tuple[dict[str, list[str]], int, int]:
    """Words of every header line by their key, where the data begin, and in which line."""
    entries: dict[str, list[str]] = {}
    for number, end, words in header_lines(path):
        if not words or words[0].startswith("#"):
            continue
        if words[0] not in _KEYS or len(words) < 2:
            raise LogError(path, f"expected a line of a PCD header, got {' '.join(words)[:40]!r}", line=number)
        entries[words[0]] = words[1:]
        if words[0] == "DATA":
            return entries, end, number + 1
    raise LogError(path, "expected a PCD header that ends with DATA, found no such line")


def _required(path: Path, entries: dict[str, list[str]], key: str) -> list[str]:
    if key not in entries:
        raise LogError(path, f"expected {key} in the PCD header, found no such line")
    return entries[key]


def _whole(path: Path, entries: dict[str, list[str]], key: str, count: int) -> list[int]:
    words = _required(path, entries, key)
    if len(words) != count or not all(word.isdecimal() and len(word) < 19 for word in words):
        raise LogError(path, f"expected {count} whole numbers in {key}, got {' '.join(words)[:40]!r}")
    return [int(word) for word in words]


def _dtype(path: Path, fields: list[str], sizes: list[int], types: list[str], counts: list[int]) -> np.dtype:
    """One packed point; fields that are not read only take their room, whatever their names."""
    for axis in "xyz":
        if fields.count(axis) != 1 or counts[fields.index(axis)] != 1:
            raise LogError(path, f"expected one field {axis}, got the fields {' '.join(fields)[:60]}")
    for name, size, kind, count in zip(fields, sizes, types, counts, strict=True):
        if f"{kind}{size}" not in _TYPES or count > LONGEST_HEADER:
            problem = f"expected a type F, I or U of 1 to 8 bytes for {name!r}, got {kind[:9]}{size} x {count}"
            raise LogError(path, problem)
    if sum(counts) > LONGEST_HEADER:
        raise LogError(path, f"expected at most {LONGEST_HEADER} numbers a point, got {sum(counts)}")
    ends = np.cumsum(np.multiply(sizes, counts)).tolist()
    places = [fields.index(axis) for axis in "xyz"]
    formats = [_TYPES[f"{types[place]}{sizes[place]}"] for place in places]
    offsets = [ends[place] - sizes[place] for place in places]
    return np.dtype({"names": list("xyz"), "formats": formats, "offsets": offsets, "itemsize": ends[-1]})


def _viewpoint(path: Path, words: list[str]) -> FloatArray | None:
    """A position and a quaternion (w, x, y, z) as a transform."""
    try:
        x, y, z, qw, qx, qy, qz = map(number_of, words)
        (pose,) = poses_of(np.array([[x, y, z, qx, qy, qz, qw]]))
    except ValueError as error:
        raise LogError(path, "expected a position and a unit quaternion in VIEWPOINT") from error
    is_identity = (x, y, z, qx, qy, qz) == (0.0,) * 6 and abs(qw) == 1.0
    return None if is_identity else pose


def _unpacked(path: Path, body: bytes, expected: int) -> bytes:
    if len(body) < 8:
        raise LogError(path, "expected the sizes of the compressed data, got the end of the file")
    packed, size = struct.unpack_from("<II", body)
    check_room(path, "the compressed data", packed, len(body) - 8)
    if size != expected:
        raise LogError(path, f"expected {expected} bytes of points, got {size} in the compressed data")
    try:
        return lzf_decompress(body[8 : 8 + packed], size)
    except ValueError as error:
        raise LogError(path, str(error)) from error


def write_pcd(path: Path | str, points: FloatArray) -> None:
    """Write points as binary PCD in double precision: organised (H, W, 3) or not (N, 3), m; NaN = no return."""
    rows = as_shape("points", points if np.ndim(points) == 3 else [points], (None, None, 3), finite=False)
    height, width, _ = rows.shape
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {width * height}\nDATA binary\n"
    )
    Path(path).write_bytes(head.encode("ascii") + rows.astype("<f8").tobytes())


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Decompress a block of which the decompressed size is known.

    The stream is a row of pieces. A first byte below 32 says how many bytes, less one, follow as they are. Any other
    holds in its upper three bits the length, less two, of a repetition (7: the next byte is added to it) and in its
    lower five the upper bits of how far back, less one, it starts; the last byte of the piece holds the lower eight.
    A ValueError says that the sizes cannot belong together (nothing is allocated then), or that the stream is damaged.
    """
    if size > 88 * len(data):  # three bytes say "repeat 264 bytes"
        raise ValueError(f"{len(data)} compressed bytes cannot hold the {size} that are declared")
    out = np.empty(size, dtype=np.uint8)
    if _decode(np.frombuffer(data, dtype=np.uint8), out) != size:
        raise ValueError("the compressed data are cut off or damaged")
    return out.tobytes()


@njit(cache=True)
def _decode(data, out):
    """Bytes written; -1 where the stream reaches beyond its ends."""
    i, o = 0, 0
    while i < len(data):
        first = np.int64(data[i])
        i += 1
        if first < 32:
            length = first + 1
            if i + length > len(data) or o + length > len(out):
                return -1
            for k in range(length):
                out[o + k] = data[i + k]
            i += length
        else:
            length = first >> 5
            if length == 7:
                if i >= len(data):
                    return -1
                length += np.int64(data[i])
                i += 1
            length += 2
            if i >= len(data):
                return -1
            start = o - ((first & 31) << 8) - np.int64(data[i]) - 1
            i += 1
            if start < 0 or o + length > len(out):
                return -1
            for k in range(length):  # byte by byte: a repetition may overlap itself
                out[o + k] = out[start + k]
        o += length
    return o
