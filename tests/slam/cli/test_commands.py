"""The command line: exit codes, one sentence on stderr, nothing half-written."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from slam.cli import main
from slam.config import SlamConfig
from spplanes import __version__
from tests.slam.commands import refused, run
from tests.slam.io.test_threedtk import scanner_points, write_scan


def test_version_and_help(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")  # whatever shell the tests run under
    assert run(capsys, "--version")[:2] == (0, f"spplanes {__version__}\n")
    for flags in (["--version", "-v"], ["-v", "--version"]):
        code, out, _ = run(capsys, *flags)
        assert code == 0 and "session.db: version 2" in out and "planes.json: spplanes/1" in out
    assert run(capsys, "-h")[1] == run(capsys, "--help")[1] and run(capsys, "slam", "-h")[0] == 0
    assert "complet" in run(capsys, "--show-completion", "bash")[1]
    code, out, _ = run(capsys, "--help")
    assert code == 0
    for command in ("slam", "demo", "simulate", "evaluate"):
        assert command in out
        assert run(capsys, command, "--help")[0] == 0


def test_unknown_commands_and_options_are_usage_errors(capsys: pytest.CaptureFixture[str]):
    assert run(capsys, "fly")[0] == 2
    assert run(capsys, "slam", "x", "--out", "y", "--nonsense")[0] == 2
    assert run(capsys, "slam")[0] == 2
    assert run(capsys, "-v")[0] == 2 and run(capsys, "-q", "-v", "fit", "x")[0] == 2


def test_a_missing_log_is_one_sentence_and_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    sentence = refused(capsys, "slam", tmp_path / "no where", "--out", tmp_path / "run")
    assert "no where: expected a log file or a folder of scans, found nothing" in sentence
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_exists_is_refused_before_any_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("keep")
    sentence = refused(capsys, "slam", tmp_path / "nowhere", "--out", tmp_path / "run")
    assert "run: exists already; give --overwrite to replace it" in sentence
    assert (tmp_path / "run" / "mine.txt").read_text() == "keep"
    (tmp_path / "file").write_text("x")
    assert "it is not a folder" in refused(capsys, "demo", "--out", tmp_path / "file", "--overwrite")


def test_unknown_keys_of_configurations_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    config = tmp_path / "config.yaml"
    config.write_text("association:\n  gap: 3\n")
    write_scan(tmp_path / "scans", 0, scanner_points())
    sentence = refused(capsys, "slam", tmp_path / "scans", "--out", tmp_path / "run", "--config", config)
    assert "config.yaml: association.gap" in sentence
    config.write_text("mapper:\n  speed: 3\n")
    sentence = refused(capsys, "slam", tmp_path / "scans", "--out", tmp_path / "run", "--config", config)
    assert "config.yaml: mapper.speed" in sentence
    config.write_text("{{{")
    assert "expected YAML, got a syntax error" in refused(
        capsys, "slam", tmp_path / "scans", "--out", tmp_path / "run", "--config", config
    )


def test_options_that_say_nothing_there_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_scan(tmp_path / "scans", 0, scanner_points())
    common = ["slam", tmp_path / "scans", "--out", tmp_path / "run"]
    for option in (["--start", "find"], ["--start-sigma", "1,1"]):
        code, _, err = run(capsys, *common, *option)
        assert code == 2 and "expected --prior" in err
    for name, value in (("topic", "/scan"), ("odometry-topic", "/o"), ("odometry-frame", "o"), ("body-frame", "b")):
        option = [f"--{name}", value]
        assert "scans: expected a bag where topics or frames are given" in refused(capsys, *common, *option)
    code = run(capsys, *common, "--odometry", "a.tum", "--odometry-topic", "/odom")[0]
    assert code == 2 and not (tmp_path / "run").exists()


def test_unknown_worlds_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert "world: expected" in refused(capsys, "simulate", "moon", "--out", tmp_path / "mission")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("missions") / "corridor"
    with pytest.raises(SystemExit) as stop:
        main(["simulate", "corridor", "--out", str(folder), "--scans", "80", "--seed", "3"])
    assert stop.value.code in (0, None)
    return folder


@pytest.fixture(scope="module")
def finished(mission: Path) -> Path:
    folder = mission.parent / "run"
    with pytest.raises(SystemExit) as stop:
        main(["slam", str(mission), "--out", str(folder)])
    assert stop.value.code in (0, None)
    return folder


def test_a_mission_from_simulation_to_score(finished: Path, mission: Path, capsys: pytest.CaptureFixture[str]):
    names = {path.name for path in finished.iterdir()}
    assert names >= {
        "config.yaml",
        "rig.yaml",
        "trajectory.tum",
        "odometry.tum",
        "planes.json",
        "map.ply",
        "metrics.json",
        "map.png",
        "report.html",
    }
    planes = json.loads((finished / "planes.json").read_text())
    assert planes["format"] == "spplanes/1" and planes["frame"] == "world"
    assert set(planes["planes"][0]) == {
        "id",
        "normal",
        "d",
        "frame",
        "covariance",
        "n_points",
        "outline",
        "observations",
    }
    code, out, _ = run(capsys, "evaluate", finished, "--truth", mission / "truth", "--json")
    assert code == 0
    rows = {row["metric"]: row["value"] for row in json.loads(out)}
    assert rows["ATE from the first pose, translation rmse"] < 0.02
    assert json.loads((finished / "metrics.json").read_text())["evaluation"] == json.loads(out)


def test_a_run_of_a_run_is_the_same_bit_for_bit(finished: Path, mission: Path, capsys: pytest.CaptureFixture[str]):
    again = mission.parent / "again"
    assert run(capsys, "slam", mission, "--out", again)[0] == 0
    for name in ("trajectory.tum", "planes.json", "map.ply", "map.png", "config.yaml"):
        assert (finished / name).read_bytes() == (again / name).read_bytes(), name


def test_a_run_ends_with_its_results_and_what_was_assumed(
    finished: Path, mission: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
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
    assert matched
    for one in matched:
        assert one["landmark"] in [candidate["landmark"] for candidate in one["candidates"]]
    for wrong in (99, "first"):
        code, _, err = run(capsys, "explain", finished, wrong)
        assert code == 2 and "Traceback" not in err
    assert "keyframe: expected an index from 0 to" in refused(capsys, "explain", finished, 99)
    assert "expected a session, found nothing" in refused(capsys, "explain", finished.parent / "nowhere", 0)


def test_demo_beats_odometry_and_leaves_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    code, out, _ = run(capsys, "demo", "--out", tmp_path / "demo", "--scans", "150", "--json")
    assert code == 0
    rows = {row["metric"]: row["value"] for row in json.loads(out)}
    assert rows["position error, rmse, estimate"] < 0.5 * rows["position error, rmse, odometry alone"]
    assert abs(rows["corridor height, estimate"] - rows["corridor height, truth"]) < 0.004
    assert abs(rows["corridor width, estimate"] - rows["corridor width, truth"]) < 0.004
    page = (tmp_path / "demo" / "report.html").read_text()
    assert "data:image/png;base64," in page and "corridor width, truth" in page
    assert "http://" not in page and "https://" not in page


def test_what_the_group_is_told_may_come_after_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for flags in (["-v", "fit", "nothing.pcd"], ["fit", "nothing.pcd", "-v"], ["fit", "-q", "nothing.pcd"]):
        assert "nothing.pcd" in refused(capsys, *flags)
    assert run(capsys, "fit", "x", "-v", "-q")[0] == 2
    assert "expected one of -v and -q" in run(capsys, "fit", "x", "-v", "-q")[2]


@pytest.mark.parametrize(
    ("text", "near"),
    [
        ("keyframes: {distanc_m: 1}", "distance_m"),
        ("keyframe: {}", "keyframes"),
        ("mapper: {min_point: 3}", "min_points"),
    ],
)
def test_a_near_key_is_proposed_for_a_typo(text: str, near: str, tmp_path: Path):
    (tmp_path / "config.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=f"did you mean {near}"):
        SlamConfig.from_yaml(tmp_path / "config.yaml")


def test_export_makes_no_folder_of_a_mistyped_path(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert "expected a file in a folder that exists" in refused(
        capsys, "export", tmp_path, "--to", tmp_path / "reslts" / "planes.ply"
    )
    assert not (tmp_path / "reslts").exists()
