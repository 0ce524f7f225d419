"""Every run ends with its verdict: a line, metrics.json, the page; the exit code only where it is asked for."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from slam.cli import app
from slam.diagnostics.verdict import Verdict
from slam.runs.stored_run import StoredRun
from slam.simulation import simulate_mission
from tests.slam.diagnostics.evidence.test_look import turned

RUNNER = CliRunner()


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hall") / "log"
    made = simulate_mission("hall", n_scans=16, seed=3)
    made.save(folder)
    turned(made.rig).to_yaml(folder.parent / "backwards.yaml")
    return folder


def test_a_sound_run_says_so_last(mission: Path, tmp_path: Path):
    done = RUNNER.invoke(app, ["slam", str(mission), "--out", str(tmp_path / "run"), "--strict-verdict"])
    assert done.exit_code == 0
    assert done.output.splitlines()[-1] == "the map is sound"
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert metrics["verdict"] == {"verdict": "sound", "reasons": []} and metrics["evidence"] == []
    assert "The map is sound." in (tmp_path / "run" / "report.html").read_text()


def test_a_broken_run_names_the_mount_and_fails_only_when_asked(mission: Path, tmp_path: Path):
    command = ["slam", str(mission), "--rig", str(mission.parent / "backwards.yaml"), "--out", str(tmp_path / "run")]
    done = RUNNER.invoke(app, [*command, "--strict-verdict"])
    assert done.exit_code == 1
    assert done.output.splitlines()[-1].startswith("the map is broken: a sensor mounted backwards")
    stored = StoredRun.read(tmp_path / "run").verdict
    assert isinstance(stored, Verdict) and stored.verdict == "broken" and stored.keyframes
    assert (tmp_path / "run" / "session.db").exists()
    viewed = RUNNER.invoke(app, ["view", str(tmp_path / "run")])
    page = (tmp_path / "run" / "report.html").read_text()
    assert viewed.exit_code == 0
    assert RUNNER.invoke(app, ["slam", "--resume", str(tmp_path / "run")]).exit_code == 0
    assert 'class="verdict broken"' in page and "mounted backwards" in page
