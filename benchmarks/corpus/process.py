"""Drives run in a process of their own with a time limit: what crashes or hangs is a row, not an end."""

import multiprocessing
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from benchmarks.corpus.catalogue import REAL_WORD, Entry
from benchmarks.corpus.score import Row
from slam.config import SlamConfig

#: What a worker is asked for: a drive and the changes to the configuration that it is run with.
Job = tuple[Entry, dict[str, Any]]


def run_entry(entry: Entry, changes: dict[str, Any]) -> Row:
    config = SlamConfig.model_validate(changes)
    if entry.name.startswith(f"{REAL_WORD}/"):
        from benchmarks.corpus.real import real_row

        return real_row(entry.name.removeprefix(f"{REAL_WORD}/"), config, entry.seed)
    from benchmarks.corpus.drives import Recipe, make_drive
    from benchmarks.corpus.handheld import HANDHELD, make_handheld
    from benchmarks.corpus.score import score
    from slam.planeslam import PlaneSlam
    from slam.runs.slam_run import run_slam

    by_hand = entry.name in HANDHELD
    drive = make_handheld(entry.name, entry.seed) if by_hand else make_drive(Recipe.parse(entry.name), entry.seed)
    slam = None if drive.prior is None else PlaneSlam(config, prior=drive.prior)
    return score(run_slam(drive.log, drive.rig, config, slam=slam), drive)


def rows_of(jobs: Sequence[Job], limit_s: float) -> Iterator[Row]:
    """A row for every job, in order; `state` is ok, skipped, error or time, each with its reason.

    One process works off the jobs; it is made anew where one took it down or took longer than the limit.
    """
    pool = None
    for entry, changes in jobs:
        pool = pool or ProcessPoolExecutor(1, multiprocessing.get_context("spawn"))
        start = time.monotonic()
        try:
            row = pool.submit(_answer, entry, changes, limit_s).result()
        except BrokenProcessPool:
            late = time.monotonic() - start >= limit_s
            row = {"state": f"time: not done within {limit_s:g} s" if late else "error: the process died"}
            pool = None
        yield {"drive": entry.name, "seed": entry.seed, **row}


def _answer(entry: Entry, changes: dict[str, Any], limit_s: float) -> Row:
    """The row of a job; the alarm ends the process where it takes too long."""
    signal.setitimer(signal.ITIMER_REAL, limit_s)
    start = time.process_time()
    try:
        row = {"state": "ok", **run_entry(entry, changes)}
    except Exception as error:  # whatever a run stumbles over is what the row says
        row = {"state": f"error: {type(error).__name__} in {_place_of(error)}: {str(error)[:160]}"}
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    return {**row, "CPU s": time.process_time() - start}


def _place_of(error: BaseException) -> str:
    """File and line of our own that an error came through last."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [one for one in frames if "/slam/" in one.filename] or list(frames)
    return f"{ours[-1].filename.rpartition('/')[2]}:{ours[-1].lineno}"
