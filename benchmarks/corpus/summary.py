"""Rows of the corpus put together by kind, and two runs of it side by side."""

from collections import defaultdict
from collections.abc import Sequence
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
    return [*(_line(kind, groups[kind]) for kind in sorted(groups, key=_rank)), _line("all", rows)]


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
        "failed": failed(rows),
        "> 10 cm, %": 100.0 * float((worst > 0.1).mean()) if worst.size else None,
        "rmse, mm": _median([1e3 * row["rmse, m"] for row in known]),
        "worst, mm": _median([1e3 * row["worst, m"] for row in known]),
        "pose NEES/dof": pose_nees(done),
        "plane NEES/dof": plane_nees(done),
        "duplicates, %": _share(done, "duplicates"),
        "invented, %": _share(done, "invented"),
        "sound/doubtful/broken": _verdicts(done),
        **{f"{judged}, warned": warned(done, judged) for judged in ("wrong", "right", "misled", "open")},
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
    return f"{sum(word in WARNED for word in meant)} of {len(meant)}" if meant else None


def _verdicts(rows: Sequence[Row]) -> str:
    said = [row["verdict"] for row in rows]
    return "/".join(str(said.count(word)) for word in ("sound", *WARNED)) if said else "-"


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _share(rows: Sequence[Row], name: str) -> float | None:
    """Percent of all planes of the rows."""
    planes = sum(row.get("planes", 0) for row in rows)
    return 100.0 * sum(row.get(name, 0) for row in rows) / planes if planes else None


#: Columns in which two runs are compared.
_COMPARED = ("failed", "> 10 cm, %", "rmse, mm", "pose NEES/dof", "plane NEES/dof", "sound/doubtful/broken")


def compared(before: Sequence[Row], after: Sequence[Row]) -> list[Row]:
    """Before and after by kind, over the drives that both have."""
    common = {key(row) for row in before} & {key(row) for row in after}
    sides = ([row for row in rows if key(row) in common] for rows in (before, after))
    old, new = ({line["kind"]: line for line in by_kind(rows)} for rows in sides)
    return [
        {"kind": kind, "runs": line["runs"], **{name: _arrow(line[name], new[kind][name]) for name in _COMPARED}}
        for kind, line in old.items()
    ]


def key(row: Row) -> tuple[str, int]:
    """Which drive a row is of."""
    return row["drive"], row["seed"]


def failed(rows: Sequence[Row]) -> int:
    """How many of the drives did not come to their end."""
    return sum(not row["state"].startswith(("ok", "skipped")) for row in rows)


def digits(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _arrow(old: Any, new: Any) -> str | None:
    """Old and new; one of them where they are alike."""
    if old is None and new is None:
        return None
    return " -> ".join(dict.fromkeys((digits(old), digits(new))))
