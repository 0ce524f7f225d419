"""Reader of text clouds (.xyz, .txt, .asc, .csv, .pts): a point a line, x y z first or named in a head."""

from __future__ import annotations

from pathlib import Path

from slam.errors import LogError
from slam.io._numbers import ascii_of, text_rows
from slam.io.clouds.cloud import Cloud, checked
from slam.io.packed import read_bytes

_COMMENTS = (b"#", b"//")


def read_text(path: Path) -> Cloud:
    """Read rows of numbers separated by blanks, commas or semicolons; `nan` is no return.

    Lines that start with # or // before the first point are comments. A line of names before the first point says which
    columns are x, y and z; without one they are the first three. A line with one whole number is the count of .pts.

    Raises:
        LogError: one sentence with file and line: what is not a number, rows of different length, fewer than three
            columns, a count that is wrong, no point at all.
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
        words = (
            text.lstrip(b"#/ ").decode("ascii", errors="replace").replace(",", " ").replace(";", " ").lower().split()
        )
        if text.startswith(_COMMENTS):
            names = words if {"x", "y", "z"} <= set(words) else names
        elif not names and {"x", "y", "z"} <= set(words):
            names = words
        elif count is None and len(words) == 1 and words[0].isdecimal() and len(words[0]) < 19:
            count = int(words[0])
        else:
            return index, names, count
    return len(lines), names, count
