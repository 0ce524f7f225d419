"""Regressions against the results that are kept: ratios of time and memory, and accuracy; never an absolute time."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from benchmarks._measure import CPU, MEMORY, Row

#: Memory below this is the allocator's, not the algorithm's, MB.
LEAST_MEMORY_MB = 4.0
#: How much worse a figure may be, by kind. Times of contenders taken in turn came out within 0.65 to 1.34 of those of
#: an idle machine where 14 processes shared two cores; times taken one after the other ("apart": a peer in its own
#: interpreter, the tenths of a mission) within 0.75 to 1.99. Accuracy was the same to the
#: last digit; it may differ by the last bits of another machine's libraries.
TOLERANCES = {"time": 1.6, "apart": 2.2, "memory": 1.5, "accuracy": 1.1}
#: Column that is a ratio of times already, in a table without contenders; only its last row's counts.
GROWTH = "of the first tenth"
Figures = dict[str, dict[str, float]]


class Accuracy(NamedTuple):
    """How a column tells what is worse."""

    badness: Callable[[float], float] = abs  # from its value to what grows as it gets worse
    slack: float = 0.0  # what may be added to it besides the tolerance


ACCURACY = {
    **dict.fromkeys(("normal, mdeg", "offset, um", "error, mm", "largest, mm", "correct"), Accuracy()),
    **dict.fromkeys(("represented, %", "purity, %"), Accuracy(lambda share: 100.0 - share, 0.1)),
    "chi2/dof": Accuracy(lambda value: abs(value - 1.0), 0.01),
}


class Verdict(NamedTuple):
    """What a gate has to say: a sentence for each regression, and how many figures were compared."""

    regressions: list[str]
    missing: list[str]  # figures that are kept and were not measured: a peer is not there
    compared: int

    @property
    def exit_code(self) -> int:
        """1 where something is worse."""
        return int(bool(self.regressions))


def figures_of(workload: str, rows: list[Row]) -> Figures:
    """Every figure in the rows of a workload, by kind and name; smaller is better.

    Of contenders: our time and our memory to those of everybody else, and our accuracy. Of a growing mission: its last
    row's `GROWTH`, under the words of the row's first column.
    """
    figures: Figures = {kind: {} for kind in TOLERANCES}
    first: dict[str, Row] = {}
    for row in rows:
        name = f"{workload}: {next(iter(row.values()))}"
        if "by" not in row:
            if row is rows[-1] and GROWTH in row:
                figures["apart"][name] = float(row[GROWTH])
            continue
        ours = first.setdefault(row["case"], row)
        if ours is row:
            figures["accuracy"] |= {f"{name}: {column}": bad for column, bad in _accuracy_of(row).items()}
            continue
        name += f", ours to {row['by']}"
        if ours.get(CPU) and row.get(CPU):
            figures["apart" if row.get("apart") else "time"][name] = ours[CPU] / row[CPU]
        if (ours.get(MEMORY) or 0.0) > LEAST_MEMORY_MB and (row.get(MEMORY) or 0.0) > LEAST_MEMORY_MB:
            figures["memory"][name] = ours[MEMORY] / row[MEMORY]
    return figures


def _accuracy_of(row: Row) -> dict[str, float]:
    """How bad each accuracy of a row is; of "found/there" how many are missing."""
    found = {}
    for column, rule in ACCURACY.items():
        value = row.get(column)
        if isinstance(value, str) and "/" in value:
            part, whole = value.split("/")
            found[column] = float(whole) - float(part)
        elif isinstance(value, int | float):
            found[column] = rule.badness(float(value))
    return found


def judge(measured: Figures, kept: Figures) -> Verdict:
    """Compare figures with those kept; what these do not know is no regression."""
    regressions, missing, compared = [], [], 0
    for kind, figures in kept.items():
        for name, before in figures.items():
            if name not in measured.get(kind, {}):
                missing.append(name)
                continue
            compared += 1
            now, rule = measured[kind][name], ACCURACY.get(name.rsplit(": ", 1)[-1])
            slack = rule.slack if rule and kind == "accuracy" else 0.0
            if not now <= TOLERANCES[kind] * before + slack:  # NaN is a regression too
                regressions.append(f"{name} ({kind}): {now:.3g}, kept {before:.3g}")
    return Verdict(regressions, missing, compared)


def figures_of_all(results: Mapping[str, Mapping[str, Any]]) -> Figures:
    """Every figure of the results of some workloads, by kind and name."""
    figures: Figures = {kind: {} for kind in TOLERANCES}
    for name, result in results.items():
        for kind, some in figures_of(name, result["rows"]).items():
            figures[kind] |= some
    return figures
