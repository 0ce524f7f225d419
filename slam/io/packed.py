"""Bytes of files, plain or gzip: whole or line by line, bounded, and what is wrong with them as one sentence."""

from __future__ import annotations

import gzip
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BufferedIOBase
from pathlib import Path

from slam.errors import LogError

#: What a gzip stream raises that is cut off or damaged.
BROKEN = (EOFError, zlib.error, gzip.BadGzipFile)
#: Up to here anything may grow, bytes.
HARMLESS_BYTES = 1 << 26
#: Beyond, more bytes from one byte than this are no sensor data: those of real logs grow 2 to 20 times.
MOST_GROWTH = 200
_CHUNK = 1 << 20


def check_ratio(path: Path, size: int, packed: int) -> None:
    """Refuse `packed` bytes that become `size`."""
    if size > HARMLESS_BYTES and size > MOST_GROWTH * packed:
        grown = size >> 20
        raise LogError(path, f"expected sensor data, got {packed} bytes that grow to {grown} MiB or more: refused")


def check_room(path: Path, what: str, needed: int, room: int) -> None:
    """Refuse what a file declares and cannot hold, before anything is allocated for it."""
    if needed > room:
        raise LogError(path, f"expected {needed} bytes for {what}, got {room}: cut off, or a wrong header")


def in_short(error: BaseException) -> str:
    """What an error says, on one line."""
    return getattr(error, "strerror", None) or " ".join(str(error).split())[:100] or type(error).__name__


@contextmanager
def damage_told(path: Path, expected: str) -> Iterator[None]:
    """Whatever other people's readers raise on a damaged file becomes one sentence: `expected`, and what they say."""
    try:
        yield
    except LogError:
        raise
    except Exception as error:
        raise LogError(path, f"{expected} ({in_short(error)})") from error


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except BROKEN:  # one of them is an OSError
        raise
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error


def file_size(path: Path) -> int:
    """Bytes of a file."""
    with _readable(path):
        return path.stat().st_size


def read_bytes(path: Path, start: int = 0, size: int = -1) -> bytes:
    """The bytes of a file from an offset, `size` at most, or all."""
    with _readable(path), path.open("rb") as stream:
        stream.seek(start)
        return stream.read(size)


def numbered_lines(path: Path, longest: int) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, neither empty nor `#` comments, of a plain or gzip file.

    Raises:
        LogError: the file cannot be read, a line has `longest` bytes or more, or the stream grows out of proportion.
        EOFError, zlib.error, gzip.BadGzipFile: the gzip stream breaks off.
    """
    with _opened(path) as (stream, packed):
        number = 0
        while line := stream.readline(longest):
            number += 1
            if len(line) == longest:
                raise LogError(path, f"expected lines shorter than {longest} bytes", line=number)
            if packed:
                check_ratio(path, stream.tell(), packed)
            text = line.decode("ascii", errors="replace").strip()
            if text and not text.startswith("#"):
                yield number, text


def read_unpacked(path: Path) -> bytes:
    """All bytes of a plain or gzip file.

    Raises:
        LogError: the file cannot be read, the gzip stream breaks off or grows out of proportion.
    """
    chunks: list[bytes] = []
    try:
        with _opened(path) as (stream, packed):
            while chunk := stream.read(_CHUNK):
                chunks.append(chunk)
                if packed:
                    check_ratio(path, stream.tell(), packed)
    except BROKEN as error:
        raise LogError(path, "the gzip data is cut off or damaged") from error
    return b"".join(chunks)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[BufferedIOBase, int]]:
    """The stream, and the size of the file if it is gzip, else 0."""
    with _readable(path):
        packed = file_size(path) if read_bytes(path, size=2) == b"\x1f\x8b" else 0
        with gzip.open(path, "rb") if packed else path.open("rb") as stream:
            yield stream, packed
