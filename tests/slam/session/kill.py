"""Runs killed at random moments, sessions damaged at random places: is anything lost, or read that is wrong?"""

import multiprocessing
import shutil
import signal
import sqlite3
import time
from collections import Counter
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slam import PlaneSlam, SlamConfig
from slam.io.load import load
from slam.output.run_folder import Source, conclude, new_run, resumed_run
from slam.runs.slam_run import run_slam
from slam.sensors.rig import Rig
from slam.session.opening import SESSION_FILE
from slam.session.store import Session, SessionDamaged, SessionError, salvage_session
from slam.simulation import simulate_mission
from slam.simulation.robots import VERTICAL

#: Short keyframes, so that there are many commits to be killed in.
CONFIG = SlamConfig.model_validate({"keyframes": {"distance_m": 0.1}})


class Job(NamedTuple):
    """A mission and its run without interruption: their folders, and how long it took."""

    mission: Path
    whole: Path
    seconds: float


def prepare(folder: Path, scans: int) -> Job:
    """A drive through a small room with its line laser alone, and its run: a few ms a keyframe."""
    mission = simulate_mission("room", n_scans=scans, seed=1)
    mission.save(folder / "mission")
    sensors = {name: one for name, one in mission.rig.sensors.items() if name != VERTICAL}
    Rig(sensors=sensors, odometry=mission.rig.odometry).to_yaml(folder / "mission" / "rig.yaml")
    work(folder / "mission", folder / "warm")
    start = time.perf_counter()
    work(folder / "mission", folder / "whole")
    return Job(folder / "mission", folder / "whole", time.perf_counter() - start)


def work(mission: Path, out: Path) -> None:
    """Run the mission, or go on with its run."""
    if (out / SESSION_FILE).exists():
        begun = resumed_run(out)
    else:
        begun = new_run(out, *load(mission), CONFIG, Source(mission), prior=None, overwrite=out.exists())
    with begun as (slam, log, rig):
        done = run_slam(log, rig, slam.config, slam=slam)
        conclude(done, out, partial(_results, done.slam))


def killed_runs(job: Job, scratch: Path, kills: int, seed: int = 0) -> Counter[str]:
    """Kill runs until there were so many kills; what was killed goes on, and may be killed again."""
    rng, found, out = np.random.default_rng(seed), Counter[str](), scratch / "killed"
    while found["killed"] < kills:
        before = _keyframes(out)
        killed = _run_until(job, out, float(rng.uniform(0.0, 1.2 * job.seconds)))
        after = _keyframes(out)
        found["killed"] += killed
        found["lost"] += before is not None and (after is None or after < before)
        if not killed or (after and _finished(out)):  # killed perhaps, but after the last word
            found["different"] += not same_run(job.whole, out)
            shutil.rmtree(out)
    if out.exists():
        found["different"] += not _finishes(job, out)
    return found


def _run_until(job: Job, out: Path, seconds: float) -> bool:
    """Run in a process of its own and kill it after so long; whether it was killed."""
    process = multiprocessing.get_context("fork").Process(target=work, args=(job.mission, out))
    process.start()
    process.join(seconds)
    process.kill()
    process.join()
    if process.exitcode not in (0, -signal.SIGKILL):
        raise RuntimeError("the run failed by itself")
    return process.exitcode != 0


def _keyframes(out: Path) -> int | None:
    """Keyframes of a session that is read to its end; None: there is none, or it is damaged."""
    try:
        with Session.open(out, read_only=True) as session:
            return sum(1 for _ in session.entries())
    except SessionError:
        return None


def same_run(first: Path, second: Path) -> bool:
    """Whether two finished runs recorded the same bytes, decisions included, and made the same map, bit for bit."""
    if any((first / name).read_bytes() != (second / name).read_bytes() for name in ("poses.bin", "planes.bin")):
        return False
    return records(first / SESSION_FILE) == records(second / SESSION_FILE)


def records(path: Path) -> list[tuple]:
    """All records of keyframes and decisions of a session."""
    with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as connection:
        keyframes = connection.execute("SELECT id, stamp_ns, data, digest FROM keyframes ORDER BY id").fetchall()
        return keyframes + connection.execute("SELECT keyframe, data, digest FROM decisions ORDER BY 1").fetchall()


def _results(slam: PlaneSlam, folder: Path) -> None:
    """What of a result must be the same: every number of poses, planes and covariances."""
    (folder / "poses.bin").write_bytes(slam.trajectory.poses.tobytes())
    planes = slam.planes
    covariances = np.array([one.plane.covariance for one in planes])
    (folder / "planes.bin").write_bytes(np.array([one.plane.frame for one in planes]).tobytes() + covariances.tobytes())


def damaged_sessions(job: Job, scratch: Path, damages: int, seed: int = 1) -> Counter[str]:
    """Damage sessions, finished ones and ones whose writer was killed, and read, salvage and finish them."""
    rng, found = np.random.default_rng(seed), Counter[str]()
    truth, victims = records(job.whole / SESSION_FILE), [job.whole, _half_done(job, scratch)]
    for trial in range(damages):
        out = shutil.copytree(victims[trial % 2], scratch / "damaged")
        _damage(out, rng)
        outcome = _read(out, truth)
        if outcome == "right":
            try:
                found["different"] += not _finishes(job, out)
            except SessionDamaged:  # in a page that a reader has no need of
                outcome = "noticed"
        found[outcome] += 1
        if outcome == "noticed":
            try:
                salvage_session(out)
                found["saved"] += 1
                found["different"] += not _finishes(job, out)
            except SessionError:
                found["beyond saving"] += 1
        shutil.rmtree(out)
    return found


def _finishes(job: Job, out: Path) -> bool:
    """Go on with a run to its end; whether it comes to the same result."""
    if _finished(out):
        return True
    work(job.mission, out)
    return same_run(job.whole, out)


def _half_done(job: Job, scratch: Path) -> Path:
    """A run killed somewhere in its second half, journal and all."""
    out, share = scratch / "half", 0.7
    while not (out / f"{SESSION_FILE}-wal").exists() or (_keyframes(out) or 0) < 3:
        shutil.rmtree(out, ignore_errors=True)
        _run_until(job, out, share * job.seconds)
        share = 0.95 * share if share > 0.3 else 1.5  # the machine may have become faster or slower since
    return out


def _damage(out: Path, rng: np.random.Generator) -> None:
    """Cut a file of the session off, flip a bit of it, or overwrite a stretch of it."""
    files = [out / f"{SESSION_FILE}{end}" for end in ("", "-wal") if (out / f"{SESSION_FILE}{end}").exists()]
    path = files[int(rng.integers(len(files)))]
    data = bytearray(path.read_bytes())
    used = max(len(data.rstrip(b"\0")), 1)  # behind it the journal has room only
    place, kind = int(rng.integers(used)), int(rng.integers(3))
    if kind == 0:
        del data[place:]
    elif kind == 1:
        data[place] ^= 1 << int(rng.integers(8))
    else:
        length = int(rng.integers(1, 5000))
        data[place : place + length] = rng.integers(0, 256, len(data[place : place + length]), dtype=np.uint8).tobytes()
    path.write_bytes(data)


def _read(out: Path, truth: list[tuple]) -> str:
    """noticed; right: all of it, or a beginning, as it was written; wrong: something that was never written."""
    try:
        with Session.open(out, read_only=True) as session:
            list(session.entries())
        found = records(out / SESSION_FILE)
    except (SessionError, sqlite3.Error):
        return "noticed"
    return "right" if set(found) <= set(truth) else "wrong"


def _finished(out: Path) -> bool:
    with Session.open(out, read_only=True) as session:
        return session.is_finished
