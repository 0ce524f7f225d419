"""Contenders on one input: times taken in turn, accuracy of what they return, peak memory in a process of their own."""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks._memory import peak_mb, process_peak_mb

PROJECT = Path(__file__).resolve().parents[1]
#: Other people's data, where they are.
DATA = PROJECT.parent / "shared" / "data"
#: One core for everybody: what a library gains by threads is not what is compared.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), "1")
Row = dict[str, Any]
#: Names of the columns every measured row has.
CPU, WALL, MEMORY, TIMES_OURS = "CPU ms", "wall ms", "peak memory MB", "time, x ours"
#: Processor time of one of the many things that a call does.
EACH = "us each"
#: In short runs, what takes longer is timed twice at most, s.
QUICK_S = 0.1


@dataclass(frozen=True)
class Task:
    """One contender of a case; the first one of a case is ours, and the measure of the others."""

    by: str  # whose it is
    work: Callable[[], Any]  # what is timed
    score: Callable[[Any], Row] = lambda _: {}  # accuracy of what it returns; not timed
    repeats: int = 5
    """How many times it is timed, after once to warm up; 1: the first time counts, for what takes seconds."""
    things: int = 0  # how many things one call does, where the time of one is a column of its own; 0: it is not


@dataclass(frozen=True)
class Peer:
    """A contender that runs elsewhere and times itself."""

    by: str
    measure: Callable[[int], Row]
    """From the number of repeats to a row with time and memory; RuntimeError: why it is not there."""
    repeats: int = 5


Case = Callable[[], Sequence[Task | Peer]]


def measured(module: str, cases: Mapping[str, Case], *, short: bool = False) -> list[Row]:
    """Rows of all cases of a module: accuracy, processor and wall time (medians), memory, and time as a ratio to ours.

    `cases` build the contenders of each, ours first; the process that measures memory finds them again as the `CASES`
    of the module. In short runs what takes longer than a moment is repeated twice at most.
    """
    rows: list[Row] = []
    for name, build in cases.items():
        contenders = build()
        tasks = [one for one in contenders if isinstance(one, Task)]
        said = printed_by(sys.executable, "-m", "benchmarks._memory", module, name) if tasks else "[]"
        timed, peaks = iter(in_turn(tasks, short=short)), iter(json.loads(said.splitlines()[-1]))  # MB of each task
        mine: list[Row] = []
        for one in contenders:
            row: Row = {"case": name, "by": one.by}
            if isinstance(one, Task):
                row |= next(timed) | {MEMORY: next(peaks)}
            else:
                try:
                    row |= one.measure(min(one.repeats, 2) if short else one.repeats) | {"apart": True}
                except RuntimeError as error:
                    row |= {"note": str(error), "apart": True}
            row[TIMES_OURS] = row[CPU] / mine[0][CPU] if mine and row.get(CPU) else (None if mine else 1.0)
            mine.append(row)
        rows += mine
    return rows


def workload(name: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """The rows of a workload, its seconds and the largest resident size of its process."""
    start = time.perf_counter()
    rows = import_module(f"benchmarks.{name}").run(**arguments)
    return {"rows": rows, "seconds": time.perf_counter() - start, "peak_MB": process_peak_mb()}


def in_turn(tasks: list[Task], *, short: bool = False) -> list[Row]:
    """Accuracy and median times of tasks, one after the other in every round, so that all meet the same machine."""
    scores, taken = [], []
    for task in tasks:
        found, seconds = _timed(task.work)
        scores.append(task.score(found))
        taken.append([seconds] if task.repeats == 1 else [])  # else it was there to warm up
    for k in range(max((task.repeats for task in tasks), default=0)):
        for task, times in zip(tasks, taken, strict=True):
            enough = short and k >= 2 and times[0][0] > QUICK_S
            if 1 < task.repeats > k and not enough:
                times.append(_timed(task.work)[1])
    return [score | _medians(task, times) for task, score, times in zip(tasks, scores, taken, strict=True)]


def _medians(task: Task, times: list[tuple[float, float]]) -> Row:
    """Columns of the times of a task."""
    cpu, wall = (1e3 * np.median(times, axis=0)).tolist()
    row: Row = {CPU: cpu, WALL: wall}
    return row | {EACH: 1e3 * cpu / task.things} if task.things else row


def _timed(work: Callable[[], Any]) -> tuple[Any, tuple[float, float]]:
    cpu, wall = time.process_time(), time.perf_counter()
    found = work()
    return found, (time.process_time() - cpu, time.perf_counter() - wall)


def measured_here(task: Task) -> Row:
    """The row of one task with its memory, by a process that does nothing else: a peer's interpreter."""
    return in_turn([task])[0] | {MEMORY: peak_mb(task.work)}


def printed_by(python: Path | str, *words: str, timeout_s: float | None = None) -> str:
    """What an interpreter prints, in a process of its own on one thread; RuntimeError: its last words."""
    here = {"cwd": PROJECT, "env": {**os.environ, **ONE_THREAD}, "timeout": timeout_s}
    done = subprocess.run([python, *words], capture_output=True, text=True, check=False, **here)
    if done.returncode:
        raise RuntimeError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
    return done.stdout
