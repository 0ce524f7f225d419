"""Raw files, plain or gzip: bounded bytes and lines, numbers and times in them, what is wrong as one sentence."""

from __future__ import annotations

import bz2
import gzip
import re
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from decimal import Decimal, DecimalException
from io import BufferedIOBase
from pathlib import Path
from typing import Any

import numpy as np

from slam.errors import LogError, cannot_be_read
from spplanes._check import FloatArray

#: What a gzip stream raises that is cut off or damaged.
BROKEN = (EOFError, zlib.error, gzip.BadGzipFile)
#: Up to here anything may grow, bytes.
HARMLESS_BYTES = 1 << 26
#: Beyond, more bytes from one byte than this are no sensor data: those of real logs grow 2 to 20 times.
MOST_GROWTH = 200


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
    """What an error says, on one line: the same of the same file, so no address of an object in it."""
    said = re.sub(r" at 0x[0-9a-fA-F]+", "", " ".join(str(error).split()))
    return getattr(error, "strerror", None) or said[:100] or type(error).__name__


@contextmanager
def damage_told(path: Path, expected: str) -> Iterator[None]:
    """Whatever other people's readers raise on a damaged file becomes one sentence: `expected`, and what they say."""
    try:
        yield
    except LogError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:  # those that readers raise have no number of the system's
            raise cannot_be_read(path, error) from error
        raise LogError(path, f"{expected} ({in_short(error)})") from error


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except BROKEN:  # one of them is an OSError
        raise
    except OSError as error:
        raise cannot_be_read(path, error) from error


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

    A LogError refuses lines of `longest` bytes and what grows out of proportion; a stream that breaks off is `BROKEN`.
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
    """All bytes of a plain or gzip file that neither breaks off nor grows out of proportion."""
    chunks: list[bytes] = []
    try:
        with _opened(path) as (stream, packed):
            while chunk := stream.read(1 << 20):
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


class TooLarge(ValueError):
    """Packed bytes that grow out of all proportion."""


def unpack(data: bytes, compression: str) -> bytes:
    """Unpack bz2, lz4 or zstd bytes, one stream after another.

    Raises `TooLarge`, EOFError where the bytes end before the stream does, and what the packages do of damaged ones.
    """
    most = max(HARMLESS_BYTES, MOST_GROWTH * len(data))
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


def _stream(compression: str) -> Any:
    if compression == "bz2":
        return bz2.BZ2Decompressor()
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor()
    from rosbags.rosbag2.storage_mcap import zstd  # the standard library's, or its backport

    return zstd.ZstdDecompressor()


def read_rows(path: Path, *, columns: int, stamp_columns: int = 0) -> tuple[np.ndarray, FloatArray, list[int]]:
    """Times (N, stamp_columns), ns, the other numbers (N, ...), and the line of every row; plain text or gzip.

    A LogError names the first row that is not `columns` finite numbers.
    """
    stamps: list[list[int]] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, words in numbered_words(path):
        with line_named(path, number):
            _check_count(words, columns)
            try:
                stamps.append([nanoseconds(word) for word in words[:stamp_columns]])
            except ValueError as error:
                raise ValueError(f"expected numbers ({error})") from error
            rows.append(floats_of(words[stamp_columns:]))
        lines.append(number)
    if not rows:
        raise LogError(path, "expected at least one line of numbers, got none")
    return np.array(stamps, dtype=np.int64), np.array(rows, dtype=np.float64), lines


def text_rows(
    path: Path,
    text: str,
    columns: int | None,
    first_line: int = 1,
    separator: str | None = None,
    *,
    finite: bool = False,
) -> FloatArray:
    """Rows of numbers, shape (N, columns), from text; unless all are to be finite, `nan` is a number.

    Columns, where none are told, are as many as the first row has; a LogError names the first line that has others.
    """
    lines = text.splitlines()
    if columns is None:
        columns = next((len(line.split(separator)) for line in lines if line.strip()), 1)
    with warnings.catch_warnings(), suppress(ValueError):
        warnings.simplefilter("ignore")  # of no rows at all: the caller says so in its own words
        rows = np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None, delimiter=separator)
        if rows.size and rows.shape[1] == columns and (not finite or np.isfinite(rows).all()):
            return rows
    slow = []  # line by line, to name the first bad one
    for number, line in enumerate(lines, start=first_line):
        if line.strip():
            words = line.split(separator)
            with line_named(path, number):
                _check_count(words, columns)
                slow.append(floats_of(words, finite=finite, separator=separator))
    return np.array(slow, dtype=np.float64).reshape(-1, columns)


def ascii_of(path: Path, data: bytes, first_line: int = 1) -> str:
    """Bytes as text; a `LogError` names the first line that is none."""
    try:
        return data.decode("ascii")
    except UnicodeDecodeError as error:
        line = first_line + data.count(b"\n", 0, error.start)
        raise LogError(path, "expected numbers as text, got other bytes", line=line) from error


def numbered_words(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and words of every line that is neither empty nor a `#` comment; plain text or gzip."""
    found: list[tuple[int, list[str]]] = []
    try:
        found.extend((number, text.split()) for number, text in numbered_lines(path, longest=1 << 16))
    except BROKEN as error:
        last = found[-1][0] if found else 0
        raise LogError(path, "the gzip stream breaks off here", line=last + 1) from error
    return found


@contextmanager
def line_named(path: Path, line: int) -> Iterator[None]:
    """What a ValueError says of a line becomes a LogError that names it."""
    try:
        yield
    except ValueError as error:
        raise LogError(path, str(error), line=line) from error


def _check_count(words: Sequence[str], columns: int) -> None:
    if len(words) != columns:
        raise ValueError(f"expected {columns} numbers, got {len(words)} words")


def floats_of(words: Sequence[str], *, finite: bool = True, separator: str | None = None) -> list[float]:
    """Words as numbers; a ValueError where one is none, `1_000` of Python's among them, or is not finite."""
    try:
        values = [number_of(word) for word in words]
    except ValueError as error:
        raise ValueError(f"expected numbers, got {(separator or ' ').join(words).strip()[:60]!r}") from error
    if finite and not np.isfinite(values).all():
        raise ValueError("expected finite numbers, got NaN or infinity")
    return values


def number_of(word: str) -> float:
    """A number as text; a ValueError for what is none, `1_000` of Python's among it."""
    try:
        return float(word if "_" not in word else "")
    except ValueError:
        raise ValueError(f"expected numbers, got {word[:20]!r}") from None


def nanoseconds(word: str) -> int:
    """Seconds as text to integer nanoseconds, exactly; a ValueError for what is no time."""
    with suppress(DecimalException):  # no number, or one that overflows
        seconds = Decimal(word if "_" not in word else "")
        if abs(seconds) <= 9e9:  # so many integer nanoseconds 64 bits hold
            return int((seconds * 1_000_000_000).to_integral_value())
    raise ValueError(f"expected a time in seconds, got {word[:20]!r}")


def seconds_from_ns(stamp_ns: int) -> str:
    """Integer nanoseconds as seconds with nine decimals, exactly."""
    return f"{Decimal(int(stamp_ns)).scaleb(-9):.9f}"
