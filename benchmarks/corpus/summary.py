"""Rows of the corpus put together by kind, and two runs of it side by side."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import chi2

from benchmarks.corpus.catalogue import Entry
from benchmarks.corpus.score import Row

#: Verdicts that warn.
WARNED = ("doubtful", "broken")


def by_kind(rows: Sequence[Row]) -> list[Row]:
    """A line for every kind of world, sensors and trouble: how far off, how honest, what the runs said."""
    groups: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        for kind in Entry(row["drive"], row["seed"]).kinds:
            groups[kind].append(row)
    ordered = sorted(groups, key=_rank)
    return [_line(kind, groups[kind]) for kind in ordered] + [_line("all", list(rows))]


def _rank(kind: str) -> int:
    """Worlds first, then sensors, then what is wrong, then real logs; within them as they came."""
    return next(k for k, start in enumerate(("world ", "sensors ", "with ", "")) if kind.startswith(start))


def _line(kind: str, rows: Sequence[Row]) -> Row:
    done = [row for row in rows if row["state"] == "ok"]
    known = [row for row in done if "rmse, m" in row]
    worst = np.array([row["worst, m"] for row in known])
    return {
        "kind": kind,
        "runs": len(rows),
        "failed": sum(not row["state"].startswith(("ok", "skipped")) for row in rows),
        "> 10 cm, %": _percent(worst > 0.1),
        "rmse, mm": _median([1e3 * row["rmse, m"] for row in known]),
        "worst, mm": _median([1e3 * row["worst, m"] for row in known]),
        "pose NEES/dof": pose_nees(done),
        "plane NEES/dof": plane_nees(done),
        "duplicates, %": _share(done, "duplicates"),
        "invented, %": _share(done, "invented"),
        "sound/doubtful/broken": _verdicts(done),
        "wrong, warned": warned(done, "wrong"),
        "right, warned": warned(done, "right"),
        "open, warned": warned(done, "open"),
    }


def pose_nees(rows: Sequence[Row]) -> str | None:
    """Median and mean of the last poses' NEES per degree of freedom, and the 95 % band of that mean."""
    pairs = [(row["pose NEES"], row["pose dof"]) for row in rows if row.get("pose NEES") is not None]
    if not pairs:
        return None
    nees, dof = np.array(pairs).T
    low, high = chi2.ppf([0.025, 0.975], dof.sum()) / dof.sum()
    return f"{np.median(nees / dof):.2f}, {nees.sum() / dof.sum():.3g} ({low:.2f} to {high:.2f})"


def plane_nees(rows: Sequence[Row]) -> str | None:
    """Median over the runs of the planes' mean NEES per degree of freedom, and the mean over all planes."""
    pairs = [(row["plane NEES/dof"], row["matched"]) for row in rows if row.get("plane NEES/dof") is not None]
    if not pairs:
        return None
    nees, count = np.array(pairs).T
    return f"{np.median(nees):.2f}, {np.average(nees, weights=count):.3g}"


def warned(rows: Sequence[Row], judged: str) -> str | None:
    """How many of the runs that truth calls so did call themselves doubtful or broken."""
    meant = [row["verdict"] for row in rows if row.get("judged") == judged]
    if not meant:
        return None
    said = "-" if set(meant) == {"-"} else str(sum(word in WARNED for word in meant))
    return f"{said} of {len(meant)}"


def _verdicts(rows: Sequence[Row]) -> str:
    said = [row.get("verdict", "-") for row in rows]
    if all(word == "-" for word in said):
        return "-"
    return "/".join(str(said.count(word)) for word in ("sound", *WARNED))


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _percent(flags: np.ndarray) -> float | None:
    return 100.0 * float(flags.mean()) if flags.size else None


def _share(rows: Sequence[Row], name: str) -> float | None:
    """Percent of all planes of the rows."""
    planes = sum(row.get("planes", 0) for row in rows)
    return 100.0 * sum(row.get(name, 0) for row in rows) / planes if planes else None


#: What is compared of two runs, and how it is made of the rows of a kind.
_COMPARED: dict[str, Callable[[Sequence[Row]], Any]] = {
    "> 10 cm, %": lambda rows: _percent(np.array([row["worst, m"] > 0.1 for row in rows if "worst, m" in row])),
    "rmse, mm": lambda rows: _median([1e3 * row["rmse, m"] for row in rows if "rmse, m" in row]),
    "pose NEES/dof": pose_nees,
    "plane NEES/dof": plane_nees,
    "sound/doubtful/broken": _verdicts,
}


def compared(before: Sequence[Row], after: Sequence[Row]) -> list[Row]:
    """Before and after by kind, over the drives that both have."""
    common = {_key(row) for row in before} & {_key(row) for row in after}
    sides = [[row for row in rows if _key(row) in common] for rows in (before, after)]
    groups: dict[str, tuple[list[Row], list[Row]]] = defaultdict(lambda: ([], []))
    for side, rows in enumerate(sides):
        for row in rows:
            for kind in [*Entry(row["drive"], row["seed"]).kinds, "all"]:
                groups[kind][side].append(row)
    lines = []
    for kind in sorted(groups, key=_rank):
        old, new = ([row for row in rows if row["state"] == "ok"] for rows in groups[kind])
        line: Row = {
            "kind": kind,
            "runs": len(groups[kind][0]),
            "failed": f"{_failed(groups[kind][0])} -> {_failed(groups[kind][1])}",
        }
        lines.append(line | {name: _arrow(made(old), made(new)) for name, made in _COMPARED.items()})
    return lines


def _key(row: Row) -> tuple[str, int]:
    return row["drive"], row["seed"]


def _failed(rows: Sequence[Row]) -> int:
    return sum(not row["state"].startswith(("ok", "skipped")) for row in rows)


def _arrow(old: Any, new: Any) -> str | None:
    """Old and new in few digits; one of them where they are alike."""
    words = [f"{value:.3g}" if isinstance(value, float) else str(value) for value in (old, new)]
    if old is None and new is None:
        return None
    return words[0] if words[0] == words[1] else " -> ".join(words)
