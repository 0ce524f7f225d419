"""Results kept as JSON beside the page that is made of them: a workload that runs again replaces its own rows only."""

from __future__ import annotations

import json
import platform
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from benchmarks._registry import WORKLOADS
from benchmarks._table import markdown
from benchmarks.peers import environment

DOCS = Path(__file__).resolve().parents[1] / "docs"
RESULTS, PAGE = DOCS / "benchmarks.json", DOCS / "benchmarks.md"
_PACKAGES = ("spplanes", "numpy", "numba", "scipy", "gtsam", "shapely", "open3d")
_INTRODUCTION = """# Benchmarks

Written by `python -m benchmarks --write`; every table says when and where it was measured. Ours and its peers run on
the same input in the same run, on one core, in turn. Times are medians; *CPU* is processor time, which another process
on the machine disturbs less. Memory is measured apart from time. `time, x ours` above 1 is how much longer a peer
takes, below 1 how much faster it is.
"""


def circumstances() -> dict[str, Any]:
    """Machine, versions and date."""
    versions = {name: _version(name) for name in _PACKAGES} | {"mrob": environment.version("mrob")}
    return {
        "date": datetime.now().strftime("%Y-%m-%d %H:%M"),
        "machine": f"{processor()}, {platform.system()} {platform.machine()}",
        "versions": {"Python": platform.python_version()} | {k: v for k, v in versions.items() if v},
    }


def processor() -> str:
    """Name of the processor and its number of cores."""
    import os

    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.processor()}, {os.cpu_count()} cores"


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def store(results: dict[str, dict[str, Any]], path: Path = RESULTS) -> dict[str, dict[str, Any]]:
    """Put results among those kept; all of them."""
    kept = json.loads(path.read_text()) if path.exists() else {}
    kept |= results
    path.write_text(json.dumps(kept, indent=1) + "\n")
    return kept


def page(kept: dict[str, dict[str, Any]]) -> str:
    """The page of all results, in the order of the registry."""
    parts = [_INTRODUCTION]
    for name, workload in WORKLOADS.items():
        if name not in kept:
            continue
        result = kept[name]
        versions = ", ".join(f"{package} {number}" for package, number in result["versions"].items())
        parts.append(
            f"## {workload.title}\n\n{workload.says}\n\n{markdown(result['rows'])}\n\n"
            f"`python -m benchmarks {name}`{' --short' if result['short'] else ''}, {result['date']}, "
            f"{result['machine']}; {versions}. It took {result['seconds']:.0f} s, its process {result['peak_MB']:.0f} "
            "MB at most.\n"
        )
    return "\n".join(parts)
