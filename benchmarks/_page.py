"""Results kept as JSON beside the page that is made of them: a workload that runs again replaces its own rows only.

Rows become text here, for the screen and for Markdown.
"""

import json
import os
import platform
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._measure import Row
from benchmarks._registry import WORKLOADS
from benchmarks.peers import environment

_HERE = Path(__file__).resolve().parent
RESULTS, PAGE = _HERE / "results.json", _HERE / "results.md"
_PACKAGES = ("spplanes", "numpy", "numba", "scipy", "gtsam", "shapely", "open3d")
_INTRODUCTION = """# Benchmarks

Written by `python -m benchmarks --write`; every table says when and where it was measured. Ours and its peers run on
the same input in the same run, on one core where they can be told to, in turn. Times are medians; *CPU* is processor
time, which another process on the machine disturbs less. Memory is measured apart from time. `time, x ours` above 1 is
how much longer a peer takes, below 1 how much faster it is.

`python -m benchmarks --short --write` measures every table within minutes, the longest missions left out; without
`--short` they are in. `--gate` compares ratios and accuracy with the results below; it is no part of the tests that
every change has to pass, for it takes as long as a short run.
"""


def circumstances() -> dict[str, Any]:
    """Machine, versions and date."""
    versions = {name: _version(name) for name in _PACKAGES}
    versions |= {name: environment.version(name) for name in environment.PEERS}
    return {
        "date": datetime.now().strftime("%Y-%m-%d %H:%M"),
        "machine": f"{processor()}, {platform.system()} {platform.machine()}",
        "versions": {"Python": platform.python_version()} | {k: v for k, v in versions.items() if v},
    }


def processor() -> str:
    """Name of the processor and its number of cores."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor()}, {os.cpu_count()} cores"


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def as_json(value: Any) -> Any:
    """Numbers of numpy as Python's own."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not known to JSON")


def kept(path: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """The results that are kept, by workload."""
    return json.loads(path.read_text()) if path.exists() else {}


def store(results: dict[str, dict[str, Any]], path: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Put results among those kept; all of them. What a short run leaves out stays, with the date of its full run."""
    every = kept(path)
    for name, result in results.items():
        older = left_out(result, every[name]) if result["short"] and name in every else []
        every[name] = {**result, "older": older}
    path.write_text(json.dumps(every, indent=1) + "\n")
    return every


def left_out(result: dict[str, Any], before: dict[str, Any]) -> list[dict[str, Any]]:
    """Groups of rows, each with its circumstances, that a full run before had and this result has not."""
    measured = {key(row) for row in result["rows"]}
    groups = [
        {name: group[name] for name in ("rows", "date", "machine", "short")}
        | {"rows": [row for row in group["rows"] if key(row) not in measured]}
        for group in (before, *before.get("older", []))
        if not group["short"]
    ]
    return [group for group in groups if group["rows"]]


def key(row: Row) -> tuple[Any, Any]:
    """What a row is of: its first column, and whose it is."""
    return next(iter(row.values())), row.get("by")


def page(results: dict[str, dict[str, Any]]) -> str:
    """The page of all results, in the order of the registry."""
    parts = [_INTRODUCTION]
    for name, workload in WORKLOADS.items():
        if name in results:
            older = results[name].get("older", [])
            rows = results[name]["rows"] + [row for group in older for row in group["rows"]]
            lines = [f"## {workload.title}", workload.says, markdown(rows), source(name, results[name])]
            parts.append("\n\n".join([*lines, *map(note, older)]) + "\n")
    return "\n".join(parts)


def source(name: str, result: dict[str, Any]) -> str:
    """The line below a table: what made it, when and where."""
    versions = ", ".join(f"{package} {number}" for package, number in result["versions"].items())
    return (
        f"`python -m benchmarks {name}{' --short' if result['short'] else ''}`, {result['date']}, {result['machine']}; "
        f"{versions}. It took {result['seconds']:.0f} s, its process {result['peak_MB']:.0f} MB at most."
    )


def note(group: dict[str, Any]) -> str:
    """The line on rows that the last run left out."""
    names = ", ".join(dict.fromkeys(str(key(row)[0]) for row in group["rows"]))
    return f"Not measured again then, from the full run of {group['date']}, {group['machine']}: {names}."


#: What is in rows for the gate alone: that a time was not taken in turn with the others.
HIDDEN = ("apart",)


def columns_of(rows: list[dict[str, Any]]) -> list[str]:
    """Every name that occurs, in the order in which they first do; not what is for the gate alone."""
    return list(dict.fromkeys(name for row in rows for name in row if name not in HIDDEN))


def cell(value: object) -> str:
    """A value as the tables show it: four digits, nothing where there is nothing."""
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1e4 else f"{value:.4g}"
    if isinstance(value, list | tuple):
        return " / ".join(cell(one) for one in value)
    return str(value)


def plain(rows: list[dict[str, Any]]) -> str:
    names = columns_of(rows)
    lines = [names, *([cell(row.get(name)) for name in names] for row in rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(names))]
    return "\n".join("  ".join(word.ljust(w) for word, w in zip(line, widths, strict=True)).rstrip() for line in lines)


def markdown(rows: list[dict[str, Any]]) -> str:
    """A Markdown table; numbers to the right."""
    names = columns_of(rows)
    numeric = [all(isinstance(row.get(name), int | float | None) for row in rows) for name in names]
    lines = [names, ["---:" if right else "---" for right in numeric]]
    lines += [[cell(row.get(name)).replace("|", "\\|") for name in names] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
