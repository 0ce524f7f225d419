"""`spplanes join`: a run's folder of several, what cannot be used named and left out, bad input in one sentence."""

import json
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import pytest

from slam.io.g2o.reader import read_g2o
from slam.io.planes_json import read_map
from slam.io.trajectories import read_tum
from slam.runs.stored_run import StoredRun
from tests.slam.commands import refused, run, values_of
from tests.slam.joining.missions import write_office


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three visits of one building, and one of another."""
    folder = tmp_path_factory.mktemp("runs")
    visits = [write_office(folder / f"visit{number}", 0, number) for number in range(3)]
    return [*visits, write_office(folder / "elsewhere", 5, 0)]


def test_join_writes_a_run_of_all_missions(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = tmp_path / "map"
    code, table, told = run(capsys, "join", *runs, "--out", out, "--json")
    assert code == 0, told
    assert "warning: elsewhere: overlaps with no other mission" in told
    rows = values_of(json.loads(table))
    assert (rows["missions"], rows["pairs compared"], rows["components"]) == (3, 6, 2)
    stored = StoredRun.read(out)
    assert len(stored.planes) == rows["planes in the map"] == len(read_map(out / "planes.json"))
    assert len(read_g2o(out / "graph.g2o").planes) >= len(stored.planes)
    joins = json.loads((out / "joins.json").read_text(encoding="utf-8"))
    assert [one["missions"] for one in joins["components"]] == [["visit0", "visit1", "visit2"], ["elsewhere"]]
    assert {one["verdict"] for one in joins["pairs"] if "elsewhere" in one["missions"]}.isdisjoint({"joined"})
    assert all(one["reason"] for one in joins["pairs"])
    for alone in runs[:3]:
        assert len(read_tum(out / "trajectories" / f"{alone.name}.tum")) == len(read_tum(alone / "trajectory.tum"))
    seen = json.loads((out / "planes.json").read_text(encoding="utf-8"))["planes"]
    assert any(len(one["seen_by"]) == 3 for one in seen)
    assert (out / "missions.png").exists() and (out / "report.html").exists()


def test_what_cannot_be_used_is_named_and_left_out(runs: list[Path], tmp_path: Path, capsys):
    damaged, newer, nothing = (tmp_path / name for name in ("damaged", "newer", "nothing"))
    for folder in (damaged, newer):
        shutil.copytree(runs[1], folder)
    data = bytearray((damaged / "session.db").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 4000] = bytes(4000)
    (damaged / "session.db").write_bytes(data)
    with closing(sqlite3.connect(newer / "session.db")) as connection:
        connection.execute("PRAGMA user_version = 99")
    given = [runs[0], damaged, newer, nothing, runs[2], runs[1]]
    code, _, told = run(capsys, "join", *given, "--out", tmp_path / "map")
    assert code == 0, told
    joins = json.loads((tmp_path / "map" / "joins.json").read_text(encoding="utf-8"))
    assert list(joins["left_out"]) == ["damaged", "newer", "nothing"]
    assert "version 3, got 99" in joins["left_out"]["newer"]
    assert joins["components"][0]["missions"] == ["visit0", "visit2", "visit1"]
    for name in ("damaged", "newer", "nothing"):
        assert f"warning: {name}: left out: " in told


def test_bad_input_is_one_sentence(runs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for words, sentence in (
        ([runs[0]], "at least two"),
        ([runs[0], runs[0]], "twice"),
        ([tmp_path / "a", tmp_path / "b"], "none that can be used"),
        ([*runs[:2], "--significance", "2"], "(0, 0.5)"),
    ):
        assert sentence in refused(capsys, "join", *words, "--out", tmp_path / "map")
    assert "exists already" in refused(capsys, "join", *runs[:2], "--out", runs[2])
    assert not (tmp_path / "map").exists()
