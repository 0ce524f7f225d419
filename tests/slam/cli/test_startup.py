"""What is refused or printed at once takes nothing that takes long to import."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from slam.session.opening import SESSION_FILE

#: Each takes a tenth of a second and more to import; pydantic, which typer needs, is not among them.
HEAVY = ("numpy", "numba", "gtsam", "scipy", "shapely", "matplotlib", "open3d", "rich")
REFUSED = {
    "an option there is not": ["slam", "--nonsense"],
    "no such command": ["nonsense"],
    "no log": ["slam", "nothing", "--out", "out"],
    "no rig": ["map", "log", "--rig", "nothing", "--out", "out"],
    "a folder that exists": ["slam", "log", "--out", "run"],
    "no run to resume": ["slam", "--resume", "nothing"],
    "no cloud": ["fit", "nothing.ply"],
    "no clouds": ["register", "a.ply", "b.ply"],
    "no world": ["simulate", "nowhere", "--out", "out"],
    "no run to export": ["export", "nothing", "--to", "x.ply"],
    "no format to export": ["export", "run", "--to", "x.nonsense"],
    "no run to view": ["view", "nothing"],
    "no run to explain": ["explain", "nothing", "3"],
    "no run to evaluate": ["evaluate", "nothing", "--truth", "truth"],
    "a folder that exists, of joined runs": ["join", "a", "b", "--out", "run"],
    "one log for a fleet": ["fleet", "log", "--out", "out"],
    "no run to import": ["import", "graph.g2o", "--run", "nothing", "--out", "out"],
}
PRINTED = {"version": ["--version"], "help": ["--help"], "help of a command": ["slam", "--help"]}
CHILD = f"""
import sys
from slam.cli import main
try:
    main(sys.argv[1:])
finally:
    print("TOOK", sorted(set({HEAVY}) & set(sys.modules)))
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "log").write_text("")
    (tmp_path / "run").mkdir()
    return tmp_path


def ran(words: list[str], folder: Path, code: str = CHILD) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    return subprocess.run(
        [sys.executable, "-c", code, *words], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize("what", [*REFUSED, *PRINTED])
def test_refusing_and_printing_import_nothing_heavy(what: str, folder: Path):
    done = ran({**REFUSED, **PRINTED}[what], folder)
    assert done.returncode == (2 if what in REFUSED else 0), done.stderr
    assert "TOOK []" in done.stdout


def test_a_run_that_is_not_finished_is_told_of_without_reading_it(folder: Path):
    code = (
        "from slam.config import SlamConfig; from slam.session.store import Session; Session.create(%r, SlamConfig())"
    )
    ran([], folder, code % str(folder / "run" / SESSION_FILE)).check_returncode()
    done = ran(["slam", "log", "--out", "run"], folder)
    assert done.returncode == 2 and "is not finished" in done.stderr
    assert "numba" not in done.stdout and "gtsam" not in done.stdout


def test_factors_are_imported_without_numba(folder: Path):
    code = "import sys, factors, gtsam; print({'numba', 'scipy', 'shapely'} & set(sys.modules))"
    assert ran([], folder, code).stdout == "set()\n"
    code = "from factors import *; print(len([plane_factor, landmark_hesse, copy_graph]))"
    assert ran([], folder, code).stdout == "3\n"


def test_the_library_is_imported_without_numba_and_gtsam(folder: Path):
    code = "import sys, spplanes, slam; print({'numba', 'gtsam', 'numpy'} & set(sys.modules))"
    assert ran([], folder, code).stdout == "set()\n"


def test_a_run_takes_no_distributions_of_scipy(folder: Path):
    """They take 0.7 s to import; `scipy.special` has what is needed of them, to the same bits."""
    code = "import sys, slam.runs.slam_run, slam.output.run_files; print('scipy.stats' in sys.modules)"
    assert ran([], folder, code).stdout == "False\n"
