"""Drives run in a process of their own with a time limit: what crashes or hangs is a row, not an end."""

from __future__ import annotations

import multiprocessing
import time
import traceback
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection
from typing import Any

from benchmarks.corpus.catalogue import REAL_WORD, Entry
from benchmarks.corpus.score import Row
from slam.config import SlamConfig

#: What a worker is asked for: a drive and the changes to the configuration that it is run with.
Job = tuple[Entry, dict[str, Any]]

_SPAWN = multiprocessing.get_context("spawn")


def run_entry(entry: Entry, changes: dict[str, Any]) -> Row:
    """Make the drive, run it, score it; in this process."""
    config = changed(changes)
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


def changed(changes: dict[str, dict[str, Any]]) -> SlamConfig:
    """The default configuration but for some fields of some sections.

    Raises:
        ValueError: a section or a field that there is not, or a value that it cannot have.
    """
    whole = SlamConfig().model_dump()
    for name, fields in changes.items():
        if name not in whole:
            raise ValueError(f"changes: expected sections of the configuration, got {name!r}")
        whole[name] |= fields
    return SlamConfig.model_validate(whole)


def rows_of(jobs: Sequence[Job], limit_s: float) -> Iterator[Row]:
    """A row for every job, in order; `state` is ok, skipped, error or time, each with its reason.

    One process works off the jobs; it is made anew where one took it down or took longer than the limit.
    """
    worker = None
    for entry, changes in jobs:
        worker = worker or _Worker()
        row = worker.ask((entry, changes), limit_s)
        if row is None or row.pop("over", False):
            worker.end()
            worker = None
        yield {"drive": entry.name, "seed": entry.seed, **(row or {"state": "error: the process died"})}
    if worker is not None:
        worker.end()


class _Worker:
    """A process that answers jobs with rows."""

    def __init__(self) -> None:
        self._pipe, theirs = _SPAWN.Pipe()
        self._process = _SPAWN.Process(target=_serve, args=(theirs,), daemon=True)
        self._process.start()
        theirs.close()

    def ask(self, job: Job, limit_s: float) -> Row | None:
        """The row, {state, over} where it took too long, None where the process died."""
        self._pipe.send(job)
        try:
            if not self._pipe.poll(limit_s):
                return {"state": f"time: not done within {limit_s:g} s", "over": True}
            return self._pipe.recv()
        except (EOFError, ConnectionError):
            return None

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _place_of(error: BaseException) -> str:
    """File and line of our own that an error came through last."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [one for one in frames if "/slam/" in one.filename] or list(frames)
    return f"{ours[-1].filename.rpartition('/')[2]}:{ours[-1].lineno}"


def _serve(pipe: Connection) -> None:
    """Answer jobs until there are no more."""
    while True:
        try:
            entry, changes = pipe.recv()
        except EOFError:
            return
        start = time.process_time()
        try:
            row = {"state": "ok", **run_entry(entry, changes)}
        except Exception as error:  # whatever a run stumbles over is what the row says
            row = {"state": f"error: {type(error).__name__} in {_place_of(error)}: {str(error)[:160]}"}
        pipe.send({**row, "CPU s": time.process_time() - start})
