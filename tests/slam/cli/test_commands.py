"""The command line: exit codes, one sentence on stderr, nothing half-written."""

import json
import shutil
from pathlib import Path

import pytest

from spplanes import __version__
from tests.slam.commands import refused, run, simulated_run, values_of
from tests.slam.io.test_threedtk import scanner_points, write_scan


def test_version_and_help(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")  # whatever shell the tests run under
    assert run(capsys, "--version")[:2] == (0, f"spplanes {__version__}\n")
    for flags in (["--version", "-v"], ["-v", "--version"]):
        code, out, _ = run(capsys, *flags)
        assert code == 0 and "session.db: version 3" in out and "planes.json: spplanes/1" in out
    assert run(capsys, "-h")[1] == run(capsys, "--help")[1] and run(capsys, "slam", "-h")[0] == 0
    assert "complet" in run(capsys, "--show-completion", "bash")[1]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("association:\n  gap: 3\n", "config.yaml: association.gap"),
        ("mapper:\n  speed: 3\n", "config.yaml: mapper.speed"),
        ("{{{", "expected YAML, got a syntax error"),
        ("keyframes: {distanc_m: 1}", "did you mean distance_m"),
        ("keyframe: {}", "did you mean keyframes"),
        ("mapper: {min_point: 3}", "did you mean min_points"),
    ],
)
def test_wrong_configurations_are_named(text: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = tmp_path / "config.yaml"
    config.write_text(text)
    write_scan(tmp_path / "scans", 0, scanner_points())
    said = refused(capsys, "slam", tmp_path / "scans", "--out", tmp_path / "run", "--config", config)
    assert sentence in said and not (tmp_path / "run").exists()


@pytest.mark.parametrize("option", ["--topic /scan", "--odometry-topic /o", "--odometry-frame o", "--body-frame b"])
def test_topics_and_frames_are_of_bags(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_scan(tmp_path / "scans", 0, scanner_points())
    said = refused(capsys, "slam", tmp_path / "scans", "--out", tmp_path / "run", *option.split())
    assert "scans: expected a bag where topics or frames are given" in said


def test_what_is_read_is_never_replaced(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = tmp_path / "data"
    write_scan(folder / "scans", 0, scanner_points())
    scan = folder / "scans" / "scan000.3d.gz"
    before = sorted(folder.rglob("*"))
    for words in (
        ["slam", folder / "scans", "--out", folder],
        ["slam", folder / "scans", "--out", folder / "scans"],
        ["slam", folder / ".." / "data" / "scans", "--out", folder / "scans"],
        ["fit", scan, "--out", folder],
        ["join", folder / "scans", tmp_path, "--out", folder / "scans"],
        ["import", scan, "--run", tmp_path / "run", "--out", folder],
    ):
        assert "give another folder for the results" in refused(capsys, *words, "--overwrite")
    assert sorted(folder.rglob("*")) == before


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated_run(tmp_path_factory.mktemp("finished"), "corridor", 80, 3)


@pytest.fixture(scope="module")
def mission(finished: Path) -> Path:
    return finished.with_name("mission")


def test_a_mission_from_simulation_to_score(finished: Path, mission: Path, capsys: pytest.CaptureFixture[str]):
    names = "config.yaml rig.yaml trajectory.tum odometry.tum planes.json map.ply metrics.json map.png report.html"
    assert {path.name for path in finished.iterdir()} >= set(names.split())
    planes = json.loads((finished / "planes.json").read_text())
    assert planes["format"] == "spplanes/1" and planes["frame"] == "world"
    keys = {"id", "normal", "d", "frame", "covariance", "n_points", "outline", "observations"}
    assert set(planes["planes"][0]) == keys
    code, out, _ = run(capsys, "evaluate", finished, "--truth", mission / "truth", "--json")
    assert code == 0 and values_of(json.loads(out))["ATE from the first pose, translation rmse"] < 0.02
    assert json.loads((finished / "metrics.json").read_text())["evaluation"] == json.loads(out)


def test_a_run_ends_with_its_results_and_what_was_assumed(mission: Path, tmp_path: Path, capsys):
    """A log without a rig: what its laser is taken for; times in one line unless all are asked for."""
    shutil.copy(mission / "log.clf.gz", tmp_path / "bare.clf.gz")
    code, out, err = run(capsys, "slam", tmp_path / "bare.clf.gz", "--out", tmp_path / "run")
    lines = err.strip().splitlines()
    assert code == 0 and lines[-2] == f"results: {tmp_path / 'run'}, the page: {tmp_path / 'run' / 'report.html'}"
    assert lines[-3].startswith("took ") and "--timings" in lines[-3] and "time, measure" not in out
    assumed = [line for line in lines if line.startswith("assumed: ")]
    assert any("no rig: " in line and "is taken for a level 2D laser with 1" in line for line in assumed)
    told = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert float(lines[-3].split()[1]) > sum(told["stages_s"].values()) - 0.1  # writing the results comes after these
    assert [f"assumed: {one}" for one in told["assumptions"]] == assumed
    code, out, err = run(capsys, "-q", "slam", mission, "--out", tmp_path / "quiet", "--timings")
    assert code == 0 and "time, measure" in out and "time, write" in out
    [rest] = [line for line in out.splitlines() if "time, imports and the rest" in line]
    assert float(rest.split("│")[2]) >= 0.0  # the whole run holds all stages, writing the results too
    *warnings, verdict = err.strip().splitlines()
    assert all(line.startswith("warning: ") for line in warnings) and verdict.startswith("the map is ")
    assert json.loads((tmp_path / "quiet" / "metrics.json").read_text())["assumptions"] == []


def test_explain_says_why(finished: Path, capsys: pytest.CaptureFixture[str]):
    code, out, _ = run(capsys, "explain", finished, 2)
    lines = out.strip().splitlines()
    assert code == 0 and lines[0].startswith("keyframe 2 at ") and any("is landmark" in line for line in lines)
    code, out, _ = run(capsys, "explain", finished, 2, "--json")
    told = json.loads(out)
    assert told["sentences"] == lines[1:] and len(told["observations"]) > 3
    matched = [one for one in told["observations"] if one["verdict"] == "match"]
    assert matched and all(one["landmark"] in [c["landmark"] for c in one["candidates"]] for one in matched)
    assert "keyframe: expected an index from 0 to" in refused(capsys, "explain", finished, 99)
    assert run(capsys, "explain", finished, "first")[0] == 2


def test_demo_beats_odometry_and_leaves_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, out, _ = run(capsys, "demo", "--out", tmp_path / "demo", "--scans", "150", "--json")
    rows = values_of(json.loads(out))
    assert code == 0 and rows["position error, rmse, estimate"] < 0.5 * rows["position error, rmse, odometry alone"]
    for name in ("corridor height", "corridor width"):
        assert abs(rows[f"{name}, estimate"] - rows[f"{name}, truth"]) < 0.004
    page = (tmp_path / "demo" / "report.html").read_text()
    assert "data:image/png;base64," in page and "corridor width, truth" in page
    assert "http://" not in page and "https://" not in page


def test_what_the_group_is_told_may_come_after_the_command(capsys: pytest.CaptureFixture[str]):
    for flags in (["-v", "fit", "nothing.pcd"], ["fit", "nothing.pcd", "-v"], ["fit", "-q", "nothing.pcd"]):
        assert "nothing.pcd" in refused(capsys, *flags)
