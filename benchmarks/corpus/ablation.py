"""`python -m benchmarks ablation`: what each mechanism earns, by the corpus with it switched off."""

import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks._page import plain
from benchmarks.corpus.__main__ import chosen, parser_of, printed, publish, write_json
from benchmarks.corpus.catalogue import Entry
from benchmarks.corpus.process import Job, rows_of
from benchmarks.corpus.score import Row
from benchmarks.corpus.summary import failed, key, plane_nees, pose_nees

#: Mechanisms that the configuration can switch off: sections of `SlamConfig`, and what their fields are without each.
SWITCHES: dict[str, dict[str, dict[str, Any]]] = {
    "loop closure": {"loops": {"max_candidates": 0}},
    "sparsification": {"thinning": {"passes": 0}},
    "late association": {"landmarks": {"waiting_keyframes": 0}},
    "robust loops": {"backend": {"robust_loops": None}},
    "robust coasting": {"coasting": {"robust": None}},
    "rivals": {"association": {"rival_log_ratio": 0.0}},
}
#: A kind is better or worse when the mean of its drives' ratios is beyond so many standard errors ...
_STANDARD_ERRORS = 2.0
#: ... of so many drives that the mechanism touches, or more.
_FEWEST = 3


def main(words: Sequence[str]) -> int:
    """Run the drives as they are and with each mechanism off; exit code 2 for options that make no sense."""
    parser = parser_of("ablation", __doc__)
    parser.add_argument("--without", nargs="+", metavar="NAME", help=f"only these out of {', '.join(SWITCHES)}")
    asked = parser.parse_args(words)
    names = asked.without or list(SWITCHES)
    try:
        entries = chosen(asked)
        if unknown := [name for name in names if name not in SWITCHES]:
            raise ValueError(f"--without: expected names out of {', '.join(SWITCHES)}, got {', '.join(unknown)}")
    except ValueError as error:
        print(f"benchmarks ablation: {error}", file=sys.stderr)
        return 2
    runs: dict[str, list[Row]] = {}
    for name in ("", *names):
        print(f"== {f'without {name}' if name else 'as it is'}", flush=True)
        jobs: list[Job] = [(entry, SWITCHES[name] if name else {}) for entry in entries]
        runs[name] = list(printed(rows_of(jobs, asked.limit)))
        if asked.json:
            write_json(asked.json, {"runs": runs})
    lines = table(runs)
    print(f"\n{plain(lines)}\n")
    if asked.write:
        seconds = sum(row.get("CPU s", 0.0) for rows in runs.values() for row in rows)
        publish("ablation", lines, short=asked.short, seconds=seconds)
    return 0


def table(runs: Mapping[str, Sequence[Row]]) -> list[Row]:
    """A line for the drives as they are (under ""), and one for each mechanism that was off."""
    return [_line(name or "none", runs[""], rows) for name, rows in runs.items()]


def _line(name: str, before: Sequence[Row], after: Sequence[Row]) -> Row:
    done = [row for row in after if row["state"] == "ok"]
    worst, ratios = [row["worst, m"] for row in done if "worst, m" in row], _ratios(before, after)
    worse, better = _moved(ratios)
    touched = np.array([one for one in ratios.values() if one != 0.0])
    return {
        "without": name,
        "drives": len(after),
        "failed": failed(after),
        "touched": len(touched),
        "rmse, x as it is": float(np.exp(np.median(touched))) if touched.size else None,
        "> 10 cm": sum(one > 0.1 for one in worst),
        "pose NEES/dof": pose_nees(done),
        "plane NEES/dof": plane_nees(done),
        "duplicates": sum(row.get("duplicates", 0) for row in done),
        "kinds worse": ", ".join(worse) or None,
        "kinds better": ", ".join(better) or None,
    }


def _ratios(before: Sequence[Row], after: Sequence[Row]) -> dict[tuple[str, int], float]:
    """Logarithm of the error without over that with the mechanism, of every drive that both ran to its end."""
    known = {key(row): row["rmse, m"] for row in before if row.get("rmse, m")}
    both = [row for row in after if row.get("rmse, m") and key(row) in known]
    return {key(row): float(np.log(row["rmse, m"] / known[key(row)])) for row in both}


def _moved(ratios: Mapping[tuple[str, int], float]) -> tuple[list[str], list[str]]:
    """Kinds of drive that are worse without the mechanism, and those that are better, beyond their spread."""
    groups: dict[str, list[float]] = defaultdict(list)
    for (drive, seed), ratio in ratios.items():
        if ratio != 0.0:
            for kind in Entry(drive, seed).kinds:
                groups[kind].append(ratio)
    worse, better = [], []
    for kind, values in ((kind, some) for kind, some in groups.items() if len(some) >= _FEWEST):
        mean, error = float(np.mean(values)), float(np.std(values, ddof=1)) / np.sqrt(len(values))
        if abs(mean) > _STANDARD_ERRORS * error:
            (worse if mean > 0.0 else better).append(f"{kind} ({np.exp(mean):.2f} x)")
    return worse, better
