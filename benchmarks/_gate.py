"""Regressions by ratio: what was measured against a small committed baseline, never an absolute time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks._measure import CPU, MEMORY, Row

BASELINE = Path(__file__).parent / "baseline.json"
#: Memory below this is the allocator's, not the algorithm's, MB.
LEAST_MEMORY_MB = 4.0
#: How much worse a ratio may be: processor times of one machine scatter by a tenth or two, of another by more.
TOLERANCE = 1.5


@dataclass(frozen=True)
class Verdict:
    """What a gate has to say."""

    regressions: list[str] = field(default_factory=list)
    """One sentence each."""
    missing: list[str] = field(default_factory=list)
    """Ratios of the baseline that were not measured: a peer is not there."""
    compared: int = 0
    """Ratios that were."""

    @property
    def exit_code(self) -> int:
        """1 where something is worse."""
        return 1 if self.regressions else 0


def ratios_of(workload: str, rows: list[Row]) -> dict[str, float]:
    """Every ratio in the rows of a workload, by name; smaller is better.

    Of measured cases: our time and our memory to those of everybody else. Of other tables: their own column `ratio`,
    under the words of the row's first column.
    """
    ratios: dict[str, float] = {}
    first: dict[str, Row] = {}
    for row in rows:
        if "by" not in row:
            if isinstance(row.get("ratio"), int | float):
                ratios[f"{workload}: {next(iter(row.values()))}"] = float(row["ratio"])
            continue
        ours = first.setdefault(row["case"], row)
        if ours is row:
            continue
        name = f"{workload}: {row['case']}, ours to {row['by']}"
        if ours.get(CPU) and row.get(CPU):
            ratios[f"{name}, time"] = ours[CPU] / row[CPU]
        if (ours.get(MEMORY) or 0.0) > LEAST_MEMORY_MB and (row.get(MEMORY) or 0.0) > LEAST_MEMORY_MB:
            ratios[f"{name}, memory"] = ours[MEMORY] / row[MEMORY]
    return ratios


def judge(measured: Mapping[str, float], baseline: Mapping[str, float], tolerance: float = TOLERANCE) -> Verdict:
    """Compare ratios with the baseline's; what the baseline does not know is no regression."""
    regressions, missing, compared = [], [], 0
    for name, before in baseline.items():
        if name not in measured:
            missing.append(name)
            continue
        compared += 1
        now = measured[name]
        if not now <= tolerance * before:  # NaN is a regression too
            regressions.append(f"{name}: {now:.3g}, baseline {before:.3g}, {now / before:.2f} times as much")
    return Verdict(regressions, missing, compared)


def read_baseline(path: Path = BASELINE) -> tuple[dict[str, float], float]:
    """Ratios and tolerance."""
    stored = json.loads(path.read_text())
    return stored["ratios"], stored["tolerance"]


def write_baseline(ratios: Mapping[str, float], path: Path = BASELINE) -> None:
    """Keep ratios as the baseline; those of workloads that were not measured stay."""
    kept = read_baseline(path)[0] if path.exists() else {}
    workloads = {name.split(":")[0] for name in ratios}
    kept = {name: value for name, value in kept.items() if name.split(":")[0] not in workloads}
    rounded = {name: float(f"{value:.3g}") for name, value in sorted((kept | dict(ratios)).items())}
    path.write_text(json.dumps({"tolerance": TOLERANCE, "ratios": rounded}, indent=1) + "\n")
