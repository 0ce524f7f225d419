"""Text files of numbers, line by line, and times as text: shared by the readers of trajectories and relations."""

from __future__ import annotations

from decimal import Decimal, DecimalException
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.io.packed import BROKEN, numbered_lines

#: The largest time, s, that integer nanoseconds in 64 bits hold.
LATEST_S = 9_000_000_000
#: Longer lines are refused before they fill the memory, bytes.
_LONGEST_LINE = 1 << 16


def read_rows(
    path: Path, *, columns: int, stamp_columns: int = 0
) -> tuple[list[list[int]], list[list[float]], list[int]]:
    """Times in ns (the first columns), the other numbers, and the line number of every row; plain text or gzip.

    Raises:
        LogError: the file cannot be read, holds no row, or a row that is not `columns` finite numbers.
    """
    stamps: list[list[int]] = []
    rows: list[list[float]] = []
    lines: list[int] = []
    for number, words in numbered_words(path):
        if len(words) != columns:
            raise LogError(path, f"expected {columns} numbers, got {len(words)} words", line=number)
        try:
            stamps.append([nanoseconds(word) for word in words[:stamp_columns]])
            rows.append([number_of(word) for word in words[stamp_columns:]])
        except ValueError as error:
            raise LogError(path, f"expected numbers ({str(error)[:60]})", line=number) from error
        if not np.isfinite(rows[-1]).all():
            raise LogError(path, "expected finite numbers, got NaN or infinity", line=number)
        lines.append(number)
    if not rows:
        raise LogError(path, "expected at least one line of numbers, got none")
    return stamps, rows, lines


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
