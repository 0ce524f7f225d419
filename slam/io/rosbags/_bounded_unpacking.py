"""Chunks and messages of bags are unpacked only as far as sensor data grow.

rosbags unpacks whatever a chunk becomes before it looks at the size that the chunk states, and that statement may be a
lie as well. So its unpackers are exchanged, once, for those here, which stop.
"""

from __future__ import annotations

import bz2
import os
from functools import cache
from types import SimpleNamespace
from typing import Any, BinaryIO

from slam.io import packed


class TooLarge(ValueError):
    """Packed bytes that grow out of all proportion."""


def unpack(data: bytes, compression: str) -> bytes:
    """Unpack bz2, lz4 or zstd bytes, one stream after another.

    Raises:
        TooLarge: more comes out than `slam.io.packed` allows.
        EOFError: the bytes end before the stream does; other errors of the packages where they are damaged.
    """
    most = max(packed.HARMLESS_BYTES, packed.MOST_GROWTH * len(data))
    pieces: list[bytes] = []
    while data:
        stream = _stream(compression)
        pieces.append(stream.decompress(data, max_length=most + 1))
        most -= len(pieces[-1])
        if most < 0:
            raise TooLarge(f"expected sensor data, got {len(data)} packed bytes that grow out of all proportion")
        if not stream.eof:
            raise EOFError("packed data that break off")
        data = stream.unused_data or b""
    return b"".join(pieces)


@cache
def bound_rosbags() -> None:
    """Let rosbags unpack with `unpack`, from now on."""
    from rosbags.rosbag1 import reader as rosbag1
    from rosbags.rosbag2 import reader as rosbag2
    from rosbags.rosbag2 import storage_mcap

    for kind in ("bz2", "lz4"):
        rosbag1.decompressors[kind] = lambda data, kind=kind: unpack(data, kind)
    for kind in ("lz4", "zstd"):
        storage_mcap.DECOMPRESSORS[kind] = lambda data, _, kind=kind: unpack(data, kind)
    whole: Any = rosbag2.zstd

    def bounded(file: BinaryIO, mode: str) -> _BoundedFile:
        size = os.fstat(file.fileno()).st_size
        return _BoundedFile(whole.open(file, mode), max(packed.HARMLESS_BYTES, packed.MOST_GROWTH * size))

    # all it has of the module: for compressed messages, and for compressed files
    rosbag2.zstd = SimpleNamespace(decompress=lambda data: unpack(data, "zstd"), open=bounded)  # type: ignore[assignment]


class _BoundedFile:
    """A packed file that can be read so far."""

    def __init__(self, file: Any, most: int) -> None:
        self._file, self._most = file, most

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size if size >= 0 else self._most + 1)
        self._most -= len(data)
        if self._most < 0:
            raise TooLarge("expected sensor data, got a packed file that grows out of all proportion")
        return data

    def __enter__(self) -> _BoundedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _stream(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor()
    from rosbags.rosbag2.storage_mcap import zstd  # the standard library's, or its backport

    return zstd.ZstdDecompressor()
