"""Every run ends with its verdict: a line, metrics.json, the page; the exit code only where it is asked for."""

import json
from pathlib import Path

import pytest

from slam.diagnostics.verdict import Verdict
from slam.runs.stored_run import StoredRun
from slam.simulation import simulate_mission
from tests.slam.commands import command, run
from tests.slam.diagnostics.evidence.test_look import turned


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hall") / "log"
    made = simulate_mission("hall", n_scans=16, seed=3)
    made.save(folder)
    turned(made.rig).to_yaml(folder.parent / "backwards.yaml")
    return folder


def test_a_sound_run_says_so_last(mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, _, told = run(capsys, "slam", mission, "--out", tmp_path / "run", "--strict-verdict")
    assert code == 0 and told.splitlines()[-1] == "the map is sound"
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["verdict"] == {"verdict": "sound", "reasons": []} and metrics["evidence"] == []
    assert "The map is sound." in (tmp_path / "run" / "report.html").read_text()


def test_a_broken_run_names_the_mount_and_fails_only_when_asked(mission: Path, tmp_path: Path, capsys):
    out = tmp_path / "run"
    options = ["--rig", mission.parent / "backwards.yaml", "--out", out, "--strict-verdict"]
    code, _, told = run(capsys, "slam", mission, *options)
    assert code == 1 and told.splitlines()[-1].startswith("the map is broken: a sensor mounted backwards")
    stored = StoredRun.read(out).verdict
    assert isinstance(stored, Verdict) and stored.verdict == "broken" and stored.keyframes
    assert (out / "session.db").exists()
    assert command("view", out) == 0 and command("slam", "--resume", out) == 0
    page = (out / "report.html").read_text()
    assert 'class="verdict broken"' in page and "mounted backwards" in page
