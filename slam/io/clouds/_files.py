"""What readers of clouds share: bytes of a file, declared sizes against real ones, rows of numbers as text."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.io._numbers import number_of
from spplanes._check import FloatArray

#: Coordinates of real points lie between these, m.
_LEAST_M, _MOST_M = 1e-20, 1e9


def file_size(path: Path) -> int:
    """Bytes of a file."""
    try:
        return path.stat().st_size
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error


def read_bytes(path: Path, start: int = 0) -> bytes:
    """The bytes of a file from an offset."""
    try:
        with path.open("rb") as stream:
            stream.seek(start)
            return stream.read()
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error


def read_head(path: Path, size: int) -> bytes:
    """The first bytes of a file, `size` at most."""
    try:
        with path.open("rb") as stream:
            return stream.read(size)
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error


def check_byte_order(path: Path, points: FloatArray) -> None:
    """Refuse points (N, 3) most of whose numbers no sensor gives: floats read in the wrong order of their bytes."""
    size = np.abs(points[np.isfinite(points) & (points != 0.0)])
    if np.count_nonzero((size < _LEAST_M) | (size > _MOST_M)) > 0.25 * size.size:
        raise LogError(path, "expected coordinates in metres, got numbers as of another byte order or type")


def check_room(path: Path, what: str, needed: int, room: int) -> None:
    """Refuse what a file declares and cannot hold, before anything is allocated for it."""
    if needed > room:
        raise LogError(path, f"expected {needed} bytes for {what}, got {room}: cut off, or a wrong header")


def text_rows(
    path: Path, data: bytes, columns: int | None, first_line: int, separator: str | None = None
) -> FloatArray:
    """Rows of numbers, shape (N, columns), from text; `nan` is a number. None: as many columns as the first row has.

    Raises:
        LogError: names the first line that is not that many numbers.
    """
    try:
        text = data.decode("ascii")
    except UnicodeDecodeError as error:
        line = first_line + data.count(b"\n", 0, error.start)
        raise LogError(path, "expected numbers as text, got other bytes", line=line) from error
    if columns is None:
        columns = next((len(_words(line, separator)) for line in text.splitlines() if line.strip()), 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of no rows at all: the caller says so in its own words
            rows = np.loadtxt(text.splitlines(), dtype=np.float64, ndmin=2, comments=None, delimiter=separator)
    except ValueError:
        rows = np.empty((0, 0))
    if rows.size and rows.shape[1] == columns:
        return rows
    return _slow_rows(path, text, columns, first_line, separator)


def _slow_rows(path: Path, text: str, columns: int, first_line: int, separator: str | None) -> FloatArray:
    """Line by line, to name the first bad one."""
    rows = []
    for number, line in enumerate(text.splitlines(), start=first_line):
        words = _words(line, separator)
        if not words:
            continue
        if len(words) != columns:
            raise LogError(path, f"expected {columns} numbers, got {len(words)} words", line=number)
        try:
            rows.append([number_of(word) for word in words])
        except ValueError as error:
            raise LogError(path, f"expected numbers, got {line.strip()[:60]!r}", line=number) from error
    return np.array(rows, dtype=np.float64).reshape(-1, columns)


def _words(line: str, separator: str | None) -> list[str]:
    return line.split(separator) if line.strip() else []
