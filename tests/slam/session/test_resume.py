"""Runs from the command line that end early and go on; their folder; full disks, read-only folders, two writers."""

import gzip
import json
import resource
import shutil
import sqlite3
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import slam.runs.slam_run as run_module
from slam import PlaneSlam
from slam.errors import LogError
from slam.geometry.frames import planar_transform
from slam.io.load import load
from slam.io.trajectories import Trajectory, read_tum, write_tum
from slam.planeslam import pose_symbol
from slam.sensors.log import LaserScan
from slam.session.opening import SESSION_FILE
from slam.session.store import Session, StorageError, salvage_session
from tests.slam.commands import assert_same_files, command, refused, run, values_of
from tests.slam.scenes import drive, run_of
from tests.slam.session import kill

#: Files of a run that must be the same however often it was interrupted; the others hold times.
SAME = ("trajectory.tum", "planes.json", "map.ply", "map.png", "config.yaml", "rig.yaml", "graph.g2o")


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> kill.Job:
    """A mission, and its run by the harness."""
    return kill.prepare(tmp_path_factory.mktemp("missions"), scans=40)


@pytest.fixture(scope="module")
def mission(job: kill.Job) -> Path:
    (job.mission.parent / "config.yaml").write_text("keyframes: {distance_m: 0.1}\n")
    return job.mission


@pytest.fixture(scope="module")
def whole(mission: Path) -> Path:
    out = mission.parent / "cli"
    assert command("slam", mission, "--out", out, "--config", mission.parent / "config.yaml") == 0
    return out


@pytest.fixture
def stopped(mission: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    """Runs that end early: after so many keyframes the next measurement fails. Exit code, stdout and stderr."""
    frames_of = run_module.keyframes_of

    def run_into(error: BaseException, out: Path, *options: object, after: int = 5) -> tuple[int, str, str]:
        def fails(log, rig, config, start=0, **parts):
            for index, frame in enumerate(frames_of(log, rig, config, start, **parts), start):
                if index == after:
                    raise error
                yield frame

        with monkeypatch.context() as patch:
            patch.setattr(run_module, "keyframes_of", fails)
            config = mission.parent / "config.yaml"
            return run(capsys, "slam", mission, "--out", out, "--config", config, *options)

    return run_into


def test_a_finished_run_has_its_session_and_nothing_else_left(whole: Path):
    names = {path.name for path in whole.iterdir()}
    assert names >= {*SAME, SESSION_FILE, "metrics.json", "report.html"}
    assert not [name for name in names if name.startswith((".", f"{SESSION_FILE}-"))]
    assert [path.name for path in whole.parent.iterdir() if path.name.startswith(".")] == []
    with Session.open(whole, read_only=True) as session:
        assert session.is_finished and len(session) > 5
        [scan] = session.scans(2)
        assert (scan.sensor, scan.scan) == ("horizontal", None) and scan.position is not None


ENDS = {
    "run": (KeyboardInterrupt(), 1),
    "log and out": (ValueError("a bad scan"), 2),
    "moved": (RuntimeError("a bug"), 1),
}


@pytest.mark.parametrize("way", ENDS)
def test_a_run_that_ended_early_goes_on_to_the_same_result(whole, mission: Path, tmp_path: Path, stopped, capsys, way):
    out, config = tmp_path / "run", mission.parent / "config.yaml"
    error, expected = ENDS[way]
    code, _, err = stopped(error, out)
    assert code == expected
    assert f"go on with: spplanes slam --resume {out}" in err
    assert {path.name.removeprefix(SESSION_FILE) for path in out.iterdir()} == {""}
    assert "exists already" in refused(capsys, "slam", mission, "--out", out, "--config", config)
    arguments = {
        "run": ["--resume", out],
        "log and out": [mission, "--out", out, "--resume"],
        "moved": [tmp_path / "elsewhere", "--out", out, "--resume"],
    }
    shutil.copytree(mission, tmp_path / "elsewhere")
    code, _, err = run(capsys, "slam", *arguments[way])
    assert code == 0, err
    assert_same_files(out, whole, SAME)
    assert kill.records(out / SESSION_FILE) == kill.records(whole / SESSION_FILE)
    code, _, err = run(capsys, "slam", "--resume", out)
    assert code == 0 and err.strip() == f"{out}: finished already; nothing is left to do"  # a supervisor may loop


def test_a_run_that_died_while_writing_results_writes_them_again(whole, mission, tmp_path: Path, monkeypatch, capsys):
    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr("slam.output.run_files.write_report", Mock(side_effect=OSError(28, "No space left")))
        assert run(capsys, "slam", mission, "--out", out, "--config", mission.parent / "config.yaml")[0] == 1
    assert [path.name for path in out.iterdir()] == [SESSION_FILE]
    assert run(capsys, "slam", "--resume", out)[0] == 0
    assert (out / "planes.json").read_bytes() == (whole / "planes.json").read_bytes()


def test_what_fails_before_the_first_keyframe_leaves_nothing(tmp_path: Path, stopped):
    old = tmp_path / "run"
    old.mkdir()
    (old / "mine.txt").write_text("keep")
    for options in ([], ["--overwrite"]):
        out = tmp_path / ("run" if options else "new")
        assert stopped(ValueError("a bad scan"), out, *options, after=0)[0] == 2
    assert (old / "mine.txt").read_text() == "keep"
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_overwriting_keeps_the_old_until_the_new_is_whole(tmp_path: Path, stopped, capsys):
    out = tmp_path / "run"
    out.mkdir()
    (out / "old.txt").write_text("old")
    assert stopped(RuntimeError("a bug"), out, "--overwrite", after=3)[0] == 1
    (kept,) = tmp_path.glob(".run-old-*")
    assert (kept / "run" / "old.txt").read_text() == "old"
    assert run(capsys, "slam", "--resume", out)[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["run"] and not (out / "old.txt").exists()


def test_only_what_a_run_replaced_goes_with_its_end(tmp_path: Path, mission: Path, capsys: pytest.CaptureFixture[str]):
    """Beside it waits the old copy of a run whose name begins as its own does."""
    out, other = tmp_path / "run[1]", tmp_path / ".run[1]-old-old-x" / "run[1]-old"
    for folder in (out, other):
        folder.mkdir(parents=True)
        (folder / "old.txt").write_text("old")
    options = ["--config", mission.parent / "config.yaml", "--overwrite"]
    assert run(capsys, "slam", mission, "--out", out, *options)[0] == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == [".run[1]-old-old-x", "run[1]"]
    assert (other / "old.txt").exists() and not (out / "old.txt").exists()


@pytest.fixture
def unfinished(tmp_path: Path, stopped) -> Path:
    stopped(KeyboardInterrupt(), tmp_path / "run")
    return tmp_path / "run"


def test_another_log_is_refused_and_one_that_grew_is_not(unfinished: Path, mission: Path, tmp_path: Path, capsys):
    other = tmp_path / "other"
    shutil.copytree(mission, other)
    lines = gzip.decompress((mission / "log.clf.gz").read_bytes()).decode().splitlines(keepends=True)
    changed = [line.replace(" 2.", " 2.1") for line in lines]
    (other / "log.clf.gz").write_bytes(gzip.compress("".join(changed).encode()))
    said = refused(capsys, "slam", other, "--out", unfinished, "--resume")
    assert "expected the log that the run began with" in said
    grown = [*lines, "# the robot drove on\n"]
    (other / "log.clf.gz").write_bytes(gzip.compress("".join(grown).encode()))
    assert run(capsys, "slam", other, "--out", unfinished, "--resume")[0] == 0


def test_what_comes_next_after_an_interruption_is_offered(unfinished: Path, mission: Path, capsys):
    said = refused(capsys, "slam", mission, "--out", unfinished)
    assert f"its run is not finished: go on with --resume {unfinished}" in said
    for words in (["view", unfinished], ["export", unfinished, "--to", unfinished.parent / "a.tum"]):
        said = refused(capsys, *words)
        assert f"the run is not finished; go on with: spplanes slam --resume {unfinished}" in said
    assert "the run is not finished" in refused(capsys, "evaluate", unfinished, "--truth", mission / "truth")
    assert run(capsys, "explain", unfinished, 2)[0] == 0


def test_a_run_with_odometry_of_its_own_file_goes_on_with_it(mission: Path, tmp_path: Path, stopped, capsys):
    """The same bits as undisturbed; the file's content, not its name, is what must be the same."""
    truth = read_tum(mission / "truth" / "trajectory.tum")
    given = tmp_path / "given.tum"
    write_tum(given, truth)
    words = ["--out", tmp_path / "whole", "--odometry", given, "--config", mission.parent / "config.yaml"]
    code, _, err = run(capsys, "slam", mission, *words)
    assert code == 0 and f"odometry: {len(truth)} poses of given.tum; the log's own" in err
    stopped(KeyboardInterrupt(), tmp_path / "run", "--odometry", given)
    write_tum(given, Trajectory(truth.stamps_ns, truth.poses @ planar_transform(0.01, 0.0, 0.01)))
    assert "expected the log that the run began with" in refused(capsys, "slam", "--resume", tmp_path / "run")
    write_tum(given, truth)
    assert run(capsys, "slam", "--resume", tmp_path / "run")[0] == 0
    assert_same_files(tmp_path / "run", tmp_path / "whole", SAME)
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["metrics"]
    assert values_of(rows)["odometry readings (given.tum)"] == len(truth)


def test_what_resume_does_not_take_is_refused(unfinished: Path, tmp_path: Path, capsys):
    for wrong in (["--resume"], ["--resume", unfinished, "--keep-raw"], ["--resume", unfinished, "--rig", "x"]):
        assert run(capsys, "slam", *wrong)[0] == 2
    assert run(capsys, "slam", unfinished, "--salvage")[0] == 2
    for path, sentence in ((tmp_path / "none", "found nothing"), (tmp_path, "expected a session, found nothing")):
        assert sentence in refused(capsys, "slam", "--resume", path)


def test_a_run_goes_on_as_the_options_of_resume_say(unfinished: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    asked: dict[str, Any] = {}

    def notes(log, rig, config, **how):
        asked.update(how, strict=config.keyframes.strict)
        raise LogError(unfinished, "enough")

    monkeypatch.setattr(run_module, "run_slam", notes)
    assert run(capsys, "slam", "--resume", unfinished, "--batch", "--no-repair", "--strict", "--jobs", 1)[0] == 2
    assert (asked["batch"], asked["repair"], asked["strict"], asked["jobs"]) == (True, False, True, 1)
    assert run(capsys, "slam", "--resume", unfinished)[0] == 2
    assert (asked["batch"], asked["repair"], asked["strict"]) == (False, True, False)


def test_a_damaged_session_is_refused_then_salvaged_with_its_raw_scans_and_finished(whole, tmp_path, stopped, capsys):
    """By value and by reference: the log read anew has the same beams at the place that was recorded."""
    out = tmp_path / "run"
    stopped(KeyboardInterrupt(), out, "--keep-raw")
    with sqlite3.connect(out / SESSION_FILE) as other:
        other.execute("UPDATE keyframes SET data = zeroblob(length(data)) WHERE id = 3")
    assert "damaged at keyframe 3 of 5" in refused(capsys, "slam", "--resume", out)
    code, _, err = run(capsys, "slam", "--resume", "--salvage", out)
    assert code == 0 and "saved 3 keyframes; the damaged file is now session.db.damaged" in err
    assert (out / f"{SESSION_FILE}.damaged").exists()
    assert (out / "planes.json").read_bytes() == (whole / "planes.json").read_bytes()
    assert salvage_session(out).startswith("nothing is damaged")
    with Session.open(out, read_only=True) as session:
        kept = [one for index in range(len(session)) for one in session.scans(index)]
        events = load(Path((session.log or {})["path"]), session.rig)[0].events
    assert len(kept) > 5
    for one in kept:
        event = events[one.position]
        assert isinstance(event, LaserScan) and (event.stamp_ns, event.sensor) == (one.stamp_ns, one.sensor)
        np.testing.assert_array_equal(event.ranges, one.scan.ranges)
        np.testing.assert_array_equal(event.angles, one.scan.angles)


def test_a_full_disk_is_one_sentence_and_what_was_recorded_is_safe(mission: Path, tmp_path: Path):
    """A limit on file sizes stands in for the full disk: the write fails in the middle of a commit."""
    out = tmp_path / "run"
    script = (
        "import resource, signal, sys; from slam.cli import main\n"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, (170_000, {resource.RLIM_INFINITY}))\n"
        f"main(['slam', {str(mission)!r}, '--out', {str(out)!r}, '--config', {str(mission.parent / 'config.yaml')!r}])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    assert "cannot be written" in done.stderr and "what was recorded before is safe" in done.stderr
    assert "Traceback" not in done.stderr
    with Session.open(out, read_only=True) as session:
        assert len(session) > 1
        assert all(entry.keyframe.observations for entry in session.entries())


def test_a_commit_that_fails_leaves_the_estimator_as_it_was(tmp_path: Path):
    frames = drive(0).keyframes
    with PlaneSlam.open(tmp_path / "session.db") as slam:
        run_of(frames[:4], slam)
        session = slam.recorder.session  # type: ignore[attr-defined]
        pages = session._db.execute("PRAGMA page_count").fetchone()[0]
        session._db.execute(f"PRAGMA max_page_count = {pages}")
        with pytest.raises(StorageError, match="the disk is full"):
            run_of(frames[4:], slam)
        known = len(slam.keyframes)
    with PlaneSlam.open(tmp_path / "session.db") as again:
        assert len(again.keyframes) in (known, known + 1)  # measured, perhaps, but not yet in the graph
        run_of(frames[len(again.keyframes) :], again)
        assert len(again.keyframes) == 15 and again.marginal_covariance(pose_symbol(14)).shape == (6, 6)


def test_a_read_only_folder(whole: Path):
    """As nobody, for root writes where it wants: reading works, writing is one sentence."""
    with tempfile.TemporaryDirectory() as scratch:
        copy = Path(scratch) / "run"
        copy.mkdir()
        shutil.copy(whole / SESSION_FILE, copy)
        for path, mode in ((Path(scratch), 0o755), (copy, 0o555), (copy / SESSION_FILE, 0o444)):
            path.chmod(mode)
        script = (
            "import os; from slam.session.store import Session, SessionError\n"
            "os.geteuid() or os.setuid(65534)\n"
            f"with Session.open({str(copy)!r}, read_only=True) as session: print(sum(1 for _ in session.entries()))\n"
            f"try: Session.open({str(copy)!r})\n"
            "except SessionError as error: print(error)\n"
        )
        try:
            done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
        finally:
            copy.chmod(0o755)
    count, sentence = done.stdout.strip().splitlines()
    assert int(count) > 5 and "cannot be written (Permission denied)" in sentence


def test_killed_runs_lose_nothing_and_damage_is_never_read_as_truth(job: kill.Job, tmp_path: Path, times):
    killed = kill.killed_runs(job, tmp_path, kills=times(3, 200), seed=4)
    assert killed["killed"] == times(3, 200)
    assert killed["lost"] == killed["different"] == 0
    damaged = kill.damaged_sessions(job, tmp_path, damages=times(8, 200), seed=5)
    assert damaged["wrong"] == damaged["different"] == 0 < damaged["noticed"]
    assert damaged["saved"] > damaged["beyond saving"]
