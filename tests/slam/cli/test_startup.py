"""What is refused or printed at once: exit codes, one sentence, nothing written, nothing heavy imported."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from slam.config import SlamConfig
from slam.session.opening import SESSION_FILE
from slam.session.store import Session

#: Each takes a tenth of a second and more to import; pydantic, which typer needs, is not among them.
HEAVY = ("numpy", "numba", "gtsam", "scipy", "shapely", "matplotlib", "open3d", "rich")
#: Command lines and what is said of them; beside them are an empty file `log` and an empty folder `run`.
REFUSED = (
    ("slam --nonsense", "No such option: --nonsense"),
    ("nonsense", "No such command 'nonsense'"),
    ("slam", "spplanes slam -h"),
    ("-v", "spplanes -h"),
    ("fit x -v -q", "expected one of -v and -q, got both"),
    ("slam nothing --out out", "nothing: expected a log file or a folder of scans, found nothing"),
    ("map log --rig nothing --out out", "nothing: cannot be read"),
    ("slam log --out run", "run: exists already; give --overwrite to replace it"),
    ("slam log --out log --overwrite", "log: exists already; it is not a folder"),
    ("slam log --out out --start find", "expected --prior"),
    ("slam log --out out --start-sigma 1,1", "expected --prior"),
    ("slam log --out out --odometry a.tum --odometry-topic /o", "--odometry: expected one source of odometry"),
    ("slam --resume nothing", "nothing: expected the folder of a run, found nothing"),
    ("fit nothing.ply", "nothing.ply: expected a file with a cloud, found none"),
    ("register a.ply b.ply", "a.ply: expected a file with a cloud, found none"),
    ("simulate nowhere --out out", "world: expected one of"),
    ("export nothing --to x.ply", "nothing: expected the folder of a run"),
    ("export run --to x.nonsense", "x.nonsense: expected a name that ends in one of"),
    ("export run --to reslts/planes.ply", "expected a file in a folder that exists"),
    ("view nothing", "nothing: expected the folder of a run"),
    ("explain nothing 3", "nothing: expected a session, found nothing"),
    ("evaluate nothing --truth truth", "nothing: expected the folder of a run"),
    ("join a b --out run", "run: exists already"),
    ("fleet log --out out", "expected at least two, got 1"),
    ("import graph.g2o --run nothing --out out", "nothing: expected the folder of a run"),
)
PRINTED = (("--version", ""), ("--help", ""), ("slam --help", ""))
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
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(("command", "sentence"), [*REFUSED, *PRINTED])
def test_refusing_says_why_and_like_printing_leaves_nothing_and_imports_nothing_heavy(command, sentence, folder: Path):
    done = ran(command.split(), folder)
    assert done.returncode == (2 if sentence else 0) and sentence in done.stderr and "Traceback" not in done.stderr
    assert "TOOK []" in done.stdout
    assert sorted(path.name for path in folder.rglob("*")) == ["log", "run"]


def test_a_run_that_is_not_finished_is_told_of_without_reading_it(folder: Path):
    Session.create(folder / "run" / SESSION_FILE, SlamConfig()).close()
    done = ran(["slam", "log", "--out", "run"], folder)
    assert done.returncode == 2 and "is not finished" in done.stderr
    assert "numba" not in done.stdout and "gtsam" not in done.stdout


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("import sys, factors, gtsam; print({'numba', 'scipy', 'shapely'} & set(sys.modules))", "set()"),
        ("from factors import *; print(len([plane_factor, landmark_hesse, copy_graph]))", "3"),
        ("import sys, spplanes, slam; print({'numba', 'gtsam', 'numpy'} & set(sys.modules))", "set()"),
        # the distributions take 0.7 s to import; `scipy.special` has what is needed of them, to the same bits
        ("import sys, slam.runs.slam_run, slam.output.run_files; print('scipy.stats' in sys.modules)", "False"),
    ],
)
def test_what_is_imported_takes_nothing_along_that_it_does_not_need(code: str, said: str, folder: Path):
    assert ran([], folder, code).stdout == f"{said}\n"
