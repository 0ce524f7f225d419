"""Numbers and times as text: words of lines, tables of numbers, and which line is wrong."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from decimal import Decimal, DecimalException
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.io.packed import BROKEN, numbered_lines
from spplanes._check import FloatArray

#: The largest time, s, that integer nanoseconds in 64 bits hold.
LATEST_S = 9_000_000_000
#: Longer lines are refused before they fill the memory, bytes.
_LONGEST_LINE = 1 << 16


def read_rows(path: Path, *, columns: int, stamp_columns: int = 0) -> tuple[np.ndarray, FloatArray, list[int]]:
    """Times (N, stamp_columns), ns, the other numbers (N, ...), and the line of every row; plain text or gzip.

    Raises:
        LogError: the file cannot be read, holds no row, or a row that is not `columns` finite numbers.
    """
    stamps: list[list[int]] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, words in numbered_words(path):
        check_count(path, words, columns, number)
        try:
            stamps.append([nanoseconds(word) for word in words[:stamp_columns]])
        except ValueError as error:
            raise LogError(path, f"expected numbers ({error})", line=number) from error
        rows.append(floats_of(path, words[stamp_columns:], number))
        lines.append(number)
    if not rows:
        raise LogError(path, "expected at least one line of numbers, got none")
    return np.array(stamps, dtype=np.int64), np.array(rows, dtype=np.float64), lines


def text_rows(
    path: Path, text: str, columns: int | None, first_line: int = 1, separator: str | None = None
) -> FloatArray:
    """Rows of numbers, shape (N, columns), from text; `nan` is a number. None: as many columns as the first row has.

    Raises:
        LogError: names the first line that is not that many numbers.
    """
    lines = text.splitlines()
    if columns is None:
        columns = next((len(line.split(separator)) for line in lines if line.strip()), 1)
    rows = quick_rows(lines, separator)
    if rows.size and rows.shape[1] == columns:
        return rows
    slow = []  # line by line, to name the first bad one
    for number, line in enumerate(lines, start=first_line):
        if line.strip():
            words = line.split(separator)
            check_count(path, words, columns, number)
            slow.append(floats_of(path, words, number, finite=False, separator=separator))
    return np.array(slow, dtype=np.float64).reshape(-1, columns)


def quick_rows(lines: list[str], separator: str | None = None) -> FloatArray:
    """Rows of numbers, shape (N, C), as numpy reads them; nothing, shape (0, 0), where it cannot."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of no rows at all: the caller says so in its own words
            return np.loadtxt(lines, dtype=np.float64, ndmin=2, comments=None, delimiter=separator)
    except ValueError:
        return np.empty((0, 0))


def ascii_of(path: Path, data: bytes, first_line: int = 1) -> str:
    """Bytes as text; a `LogError` names the first line that is none."""
    try:
        return data.decode("ascii")
    except UnicodeDecodeError as error:
        line = first_line + data.count(b"\n", 0, error.start)
        raise LogError(path, "expected numbers as text, got other bytes", line=line) from error


def numbered_words(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and words of every line that is neither empty nor a `#` comment; plain text or gzip.

    Raises:
        LogError: the file cannot be read, a line is too long, or the gzip stream breaks off.
    """
    found: list[tuple[int, list[str]]] = []
    try:
        found.extend((number, text.split()) for number, text in numbered_lines(path, _LONGEST_LINE))
    except BROKEN as error:
        last = found[-1][0] if found else 0
        raise LogError(path, "the gzip stream breaks off here", line=last + 1) from error
    return found


def check_count(path: Path, words: Sequence[str], columns: int, line: int) -> None:
    """Refuse a line of another number of words."""
    if len(words) != columns:
        raise LogError(path, f"expected {columns} numbers, got {len(words)} words", line=line)


def floats_of(
    path: Path, words: Sequence[str], line: int, *, finite: bool = True, separator: str | None = None
) -> list[float]:
    """The numbers of a line; a `LogError` where a word is none, `1_000` of Python's among them, or is not finite."""
    try:
        values = [number_of(word) for word in words]
    except ValueError as error:
        raise LogError(
            path, f"expected numbers, got {(separator or ' ').join(words).strip()[:60]!r}", line=line
        ) from error
    if finite and not np.isfinite(values).all():
        raise LogError(path, "expected finite numbers, got NaN or infinity", line=line)
    return values


def number_of(word: str) -> float:
    """A number as text; a ValueError for what is none, `1_000` of Python's among it."""
    if "_" in word:
        raise ValueError(f"expected a number, got {word[:20]!r}")
    return float(word)


def nanoseconds(word: str) -> int:
    """Seconds as text to integer nanoseconds, exactly; a ValueError for what is no time."""
    try:
        seconds = Decimal(word if "_" not in word else "")
        plausible = abs(seconds) <= LATEST_S
    except DecimalException:  # no number, or one that overflows
        plausible, seconds = False, Decimal(0)
    if not plausible:
        raise ValueError(f"expected a time in seconds, got {word[:20]!r}")
    return int((seconds * 1_000_000_000).to_integral_value())


def seconds_from_ns(stamp_ns: int) -> str:
    """Integer nanoseconds as seconds with nine decimals, exactly."""
    sign = "-" if stamp_ns < 0 else ""
    seconds, rest = divmod(abs(stamp_ns), 1_000_000_000)
    return f"{sign}{seconds}.{rest:09d}"
