"""What waiting for the libraries costs: imports, the command line's help, and compilation on the first call ever.

Run as ``python -m benchmarks.startup``. Fresh interpreters in turn; the first round, which reads files from disk, is
not counted.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks._measure import ONE_THREAD, PROJECT, Row
from benchmarks._table import plain

REPEATS = 7
#: Exit code of commands that refuse what they are given.
REFUSED = 2
#: What each row runs; the first two are what the others are beside.
COMMANDS: dict[str, list[str]] = {
    "python": ["-c", "pass"],
    "import numba": ["-c", "import numba"],
    "import spplanes": ["-c", "import spplanes"],
    "from spplanes import fit_plane": ["-c", "from spplanes import fit_plane"],
    "from spplanes import *": ["-c", "from spplanes import *"],
    "import gtsam": ["-c", "import gtsam"],
    "import factors": ["-c", "import factors"],
    "from slam import PlaneSlam": ["-c", "from slam import PlaneSlam"],
    "spplanes --help": ["-m", "slam.cli", "--help"],
    "spplanes slam --help": ["-m", "slam.cli", "slam", "--help"],
    "spplanes --version": ["-m", "slam.cli", "--version"],
    "spplanes slam, no such option": ["-m", "slam.cli", "slam", "--nonsense"],
    "spplanes slam, no such log": ["-m", "slam.cli", "slam", "nothing", "--out", "nothing"],
    "spplanes fit, no such cloud": ["-m", "slam.cli", "fit", "nothing.ply"],
    "spplanes export, no such run": ["-m", "slam.cli", "export", "nothing", "--to", "nothing.ply"],
}
#: What a first call compiles: a fit, a segmentation, lines.
FIRST_CALLS: dict[str, str] = {
    "fit_plane": "from spplanes import fit_plane; fit_plane(rng.random((99, 3)) * [1, 1, 0.01], sigma=0.01)",
    "segment_scans": "from spplanes import segment_scans; "
    "segment_scans(np.dstack([*np.mgrid[:40, :40] * 0.05, np.ones((40, 40))]), sigma=0.01)",
    "extract_lines": "from spplanes import extract_lines; "
    "a = np.linspace(-1, 1, 181); extract_lines(2 / np.cos(a), a, sigma=0.01)",
    "a keyframe of a corridor": "from slam.simulation import simulate_mission; "
    "from slam.runs.slam_run import run_slam; "
    "from slam.config import SlamConfig; m = simulate_mission('corridor', n_scans=30, seed=0); "
    "run_slam(m.log, m.rig, SlamConfig())",
}


def run(*, short: bool = False) -> list[Row]:
    """Rows of imports, the command line and, unless short, first calls."""
    rows = imports(3 if short else REPEATS)
    return rows if short else rows + [first_call(name, code) for name, code in FIRST_CALLS.items()]


def imports(repeats: int) -> list[Row]:
    """Each command in turn, repeatedly."""
    taken: dict[str, list[tuple[float, float, float]]] = {name: [] for name in COMMANDS}
    for name in [*COMMANDS, *(list(COMMANDS) * repeats)]:
        taken[name].append(spawn(COMMANDS[name]))
    numba = np.median(taken["import numba"][1:], axis=0)
    rows = []
    for name, times in taken.items():
        wall, cpu, memory = np.median(times[1:], axis=0)
        fastest = min(t[0] for t in times[1:])
        beyond = None if name == "python" or name.startswith("spplanes") else float(wall - numba[0])
        rows.append(
            {"what": name, "s": float(wall), "fastest s": fastest, "CPU s": float(cpu), "beyond numba s": beyond}
            | {
                "beyond numba, CPU s": None if beyond is None else float(cpu - numba[1]),
                "x numba": float(cpu / numba[1]),
                "peak memory MB": float(memory),
            }
        )
    return rows


def first_call(name: str, code: str) -> Row:
    """A call with nothing compiled, and the same from the cache that it leaves, imports included."""
    with tempfile.TemporaryDirectory() as cache:
        words = ["-c", f"import numpy as np; rng = np.random.default_rng(0); {code}"]
        environment = {"NUMBA_CACHE_DIR": cache}
        first, again = spawn(words, environment), min(spawn(words, environment) for _ in range(3))
        size = sum(file.stat().st_size for file in Path(cache).rglob("*") if file.is_file())
    return {
        "what": f"first {name}: s cached, s to compile once, MB of cache",
        "s": again[0],
        "CPU s": again[1],
        "compiling, CPU s": first[1] - again[1],
        "cache MB": size / 1e6,
        "peak memory MB": first[2],
    }


def spawn(words: list[str], more: dict[str, str] | None = None) -> tuple[float, float, float]:
    """Wall and processor seconds and peak memory (MB) of a fresh interpreter.

    Raises:
        RuntimeError: it failed.
    """
    environment = {**os.environ, **ONE_THREAD, **(more or {}), "PYTHONPATH": str(PROJECT)}
    quiet = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    start = time.perf_counter()
    child = os.posix_spawn(sys.executable, [sys.executable, *words], environment, file_actions=quiet)
    _, status, usage = os.wait4(child, 0)
    wall = time.perf_counter() - start
    if os.waitstatus_to_exitcode(status) not in (0, REFUSED):
        raise RuntimeError(f"{' '.join(words)}: exit status {status}")
    return wall, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024.0


def main() -> None:
    """Print the table."""
    print(plain(run()))


if __name__ == "__main__":
    main()
