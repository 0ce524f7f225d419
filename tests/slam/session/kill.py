"""Runs killed at random moments, sessions damaged at random places: is anything lost, or read that is wrong?"""

from __future__ import annotations

import os
import shutil
import signal
import sqlite3
import time
import traceback
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np

from slam import PlaneSlam, SlamConfig
from slam.io.load import load
from slam.output.run_folder import Source, conclude, new_run, resumed_run
from slam.runs.slam_run import run_slam
from slam.sensors.rig import Rig
from slam.session.opening import SESSION_FILE
from slam.session.salvage import salvage_session
from slam.session.store import Session, SessionDamaged, SessionError
from slam.simulation import simulate_mission
from slam.simulation.robots import VERTICAL

#: Short keyframes, so that there are many commits to be killed in.
CONFIG = SlamConfig.model_validate({"keyframes": {"distance_m": 0.1}})
_FILES = ("", "-wal", "-shm")


@dataclass(frozen=True)
class Job:
    """A mission and its run without interruption."""

    mission: Path
    """Folder of the mission."""
    whole: Path
    """Folder of the run."""
    seconds: float
    """How long that took."""


def prepare(folder: Path, scans: int) -> Job:
    """A drive through a small room with its line laser alone, and its run: a few ms a keyframe."""
    mission = simulate_mission("room", n_scans=scans, seed=1)
    mission.save(folder / "mission")
    sensors = {name: one for name, one in mission.rig.sensors.items() if name != VERTICAL}
    Rig(sensors=sensors, odometry=mission.rig.odometry).to_yaml(folder / "mission" / "rig.yaml")
    work(folder / "mission", folder / "warm", None)
    start = time.perf_counter()
    work(folder / "mission", folder / "whole", None)
    return Job(folder / "mission", folder / "whole", time.perf_counter() - start)


def work(mission: Path, out: Path, acknowledge: int | None) -> None:
    """Run the mission, or go on with its run; says into a pipe which keyframe is done."""

    def progress(done: int, total: int) -> None:
        if acknowledge is not None:
            os.write(acknowledge, done.to_bytes(4, "little"))

    if (out / SESSION_FILE).exists():
        with resumed_run(out) as (slam, log, rig):
            done = run_slam(log, rig, slam.config, slam=slam, progress=progress)
            conclude(done, out, partial(_results, done.slam))
        return
    log, rig = load(mission)
    with new_run(out, log, rig, CONFIG, Source(mission), prior=None, overwrite=out.exists()) as slam:
        done = run_slam(log, rig, CONFIG, slam=slam, progress=progress)
        conclude(done, out, partial(_results, done.slam))


def kill_row(job: Job, scratch: Path, kills: int, seed: int = 0) -> dict:
    """Kill runs until there were so many kills; what was killed goes on, and may be killed again."""
    rng = np.random.default_rng(seed)
    counts = dict.fromkeys(("runs", "lost", "damaged", "different"), 0)
    killed, out = 0, scratch / "killed"
    while killed < kills:
        said, dead = _run_until(job, out, float(rng.uniform(0.0, 1.2 * job.seconds)))
        killed += dead
        known = _keyframes(out)
        counts["lost"] += known is not None and known < said
        counts["damaged"] += known is None and said > 0
        if not dead or (known and _finished(out)):  # killed perhaps, but after the last word
            counts["runs"] += 1
            counts["different"] += not same_run(job.whole, out)
            shutil.rmtree(out)
    if out.exists():
        work(job.mission, out, None)
        counts["different"] += not same_run(job.whole, out)
    return {"what": "killed at a random moment", "trials": killed, **counts}


def _run_until(job: Job, out: Path, seconds: float) -> tuple[int, bool]:
    """Run in a process of its own and kill it after so long; keyframes it acknowledged, and whether it was killed."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(reader)
        _child(job, out, writer)
    os.close(writer)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    said = b""
    while block := os.read(reader, 1 << 16):
        said += block
    os.close(reader)
    if os.WIFEXITED(status) and os.WEXITSTATUS(status) != 0:
        raise RuntimeError("the run failed by itself")
    return int.from_bytes(said[len(said) // 4 * 4 - 4 :][:4], "little") if said else 0, os.WIFSIGNALED(status)


def _child(job: Job, out: Path, acknowledge: int) -> NoReturn:  # type: ignore[bad-return]  # never: `os._exit`
    code = 1
    try:
        work(job.mission, out, acknowledge)
        code = 0
    except BaseException:
        traceback.print_exc()
        raise
    finally:
        os._exit(code)


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


def damage_row(job: Job, scratch: Path, damages: int, seed: int = 1) -> dict:
    """Damage sessions, finished ones and ones whose writer was killed, and read, salvage and finish them."""
    rng = np.random.default_rng(seed)
    truth = records(job.whole / SESSION_FILE)
    victims = [job.whole, _half_done(job, scratch)]
    counts: dict[str, int] = dict.fromkeys(
        ("noticed", "harmless", "shorter", "wrong", "saved", "beyond saving", "different"), 0
    )
    for trial in range(damages):
        out = scratch / "damaged"
        shutil.copytree(victims[trial % 2], out)
        _damage(out, rng)
        outcome = _read(out, truth, victims[trial % 2])
        if outcome != "noticed":
            try:
                counts["different"] += not _finishes(job, out)
            except SessionDamaged:  # in a page that a reader has no need of
                outcome = "noticed"
        counts[outcome] += 1
        if outcome == "noticed":
            try:
                salvage_session(out)
                counts["saved"] += 1
                counts["different"] += not _finishes(job, out)
            except SessionError:
                counts["beyond saving"] += 1
        shutil.rmtree(out)
    return {"what": "damaged at a random place", "trials": damages, **counts}


def _finishes(job: Job, out: Path) -> bool:
    """Go on with a run to its end; whether it comes to the same result."""
    if _finished(out):
        return True
    work(job.mission, out, None)
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
    files = [out / f"{SESSION_FILE}{end}" for end in _FILES[:2] if (out / f"{SESSION_FILE}{end}").exists()]
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


def _read(out: Path, truth: list[tuple], original: Path) -> str:
    """noticed; harmless: all there as it was; shorter: a true beginning; wrong: something that was never written."""
    try:
        with Session.open(out, read_only=True) as session:
            count = sum(1 for _ in session.entries())
        found = records(out / SESSION_FILE)
    except (SessionError, sqlite3.Error):
        return "noticed"
    if not set(found) <= set(truth):
        return "wrong"
    return "harmless" if count >= (_keyframes(original) or 0) else "shorter"


def _finished(out: Path) -> bool:
    with Session.open(out, read_only=True) as session:
        return session.is_finished
