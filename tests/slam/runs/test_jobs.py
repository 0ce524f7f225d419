"""A run by several processes is the run by one, to the bit."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from slam.config import SlamConfig
from slam.frontend.keyframes import keyframes_of
from slam.io.load import load
from slam.runs.slam_run import Run, run_slam
from slam.session._codec import encode
from slam.simulation import Mission, simulate_mission
from tests.slam.commands import assert_same_files, run

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")


@pytest.fixture(scope="module", params=["corridor", "room", "hall"])
def mission(request: pytest.FixtureRequest) -> Mission:
    return simulate_mission(request.param, n_scans={"corridor": 80, "room": 120, "hall": 8}[request.param], seed=3)


def told(run: Run) -> list[bytes]:
    """Everything that a run came to, as bytes."""
    planes = [repr(one.plane.to_dict()).encode() for one in run.planes]
    return [run.trajectory.poses.tobytes(), *planes, *(encode(list(one)) for one in run.slam.decisions)]


def test_a_run_is_the_same_however_many_measure(mission: Mission):
    runs = [run_slam(mission.log, mission.rig, SlamConfig(), jobs=jobs) for jobs in (1, 2, 3)]
    assert len(runs[0].trajectory) > 3 and runs[0].planes and told(runs[0]) == told(runs[1]) == told(runs[2])


def test_linear_algebra_takes_one_thread_while_a_run_lasts(mission: Mission):
    def threads() -> set[int]:
        return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

    during: list[set[int]] = []
    with threadpool_limits(2, user_api="blas"):
        run_slam(mission.log, mission.rig, SlamConfig(), progress=lambda *_: during.append(threads()))
        assert threads() == {2}
    assert during and all(one == {1} for one in during)


def test_fewer_than_one_job_is_refused(mission: Mission):
    with pytest.raises(ValueError, match="jobs: expected"):
        run_slam(mission.log, mission.rig, SlamConfig(), jobs=0)


def test_scans_on_the_disk_are_read_by_all_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A file's position is one for all processes that were forked with it open."""
    monkeypatch.setattr("slam.lazy._IN_MEMORY_BYTES", 1 << 10)
    simulate_mission("room", n_scans=120, seed=0).save(tmp_path / "room")
    alone, shared = (list(keyframes_of(*load(tmp_path / "room"), SlamConfig(), jobs=jobs)) for jobs in (1, 3))
    assert [encode(one.observations) for one in alone] == [encode(one.observations) for one in shared]


def test_a_run_that_was_killed_is_resumed_at_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Nor do the processes outlive it that measure, nor is the session theirs. Killed with keyframes in its journal."""
    simulate_mission("corridor", n_scans=90, seed=0).save(tmp_path / "log")
    words = [sys.executable, "-m", "slam.cli", "slam", "log", "--out", "killed", "--jobs", "2"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3])}
    nowhere = subprocess.DEVNULL
    killed = subprocess.Popen(words, env=environment, cwd=tmp_path, stdout=nowhere, stderr=nowhere)
    journal = tmp_path / "killed" / "session.db-wal"
    while killed.poll() is None and not (journal.exists() and journal.stat().st_size > 150_000):
        time.sleep(0.01)
    assert killed.poll() is None
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    for out, more in (("killed", ["--resume"]), ("whole", [tmp_path / "log", "--jobs", 1, "--out"])):
        code, _, said = run(capsys, "slam", *more, tmp_path / out)
        assert code == 0, (out, said)
    assert_same_files(tmp_path / "killed", tmp_path / "whole", ("planes.json", "trajectory.tum", "graph.g2o"))
