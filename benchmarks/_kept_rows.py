"""Rows of long benchmarks, one JSON line each, so that an interrupted run keeps what it has."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

Row = dict[str, Any]


def append_row(path: Path, row: Row) -> None:
    """Write a row to the end of a file, on disk before this returns; after a line cut short, on a line of its own."""
    with path.open("a+b") as stream:
        if stream.tell():
            stream.seek(-1, os.SEEK_END)
            if stream.read(1) != b"\n":
                stream.write(b"\n")
        stream.write(json.dumps(row).encode() + b"\n")
        stream.flush()
        os.fsync(stream.fileno())


def read_rows(paths: Iterable[Path]) -> list[Row]:
    """The rows of several files by seed, each seed once (the last wins); lines cut short are left out."""
    rows: dict[int, Row] = {}
    for path in paths:
        for line in path.read_text().splitlines() if path.exists() else ():
            try:
                row = json.loads(line)
            except json.JSONDecodeError:
                continue
            rows[row["seed"]] = row
    return [rows[seed] for seed in sorted(rows)]


def seeds_left(seeds: Sequence[int], kept: Sequence[Row]) -> list[int]:
    """The seeds that no kept row is of."""
    done = {row["seed"] for row in kept}
    return [seed for seed in seeds if seed not in done]
