"""A row of a table measured in a process of its own, whose memory is a column of it."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from benchmarks._measure import MEMORY, Row
from benchmarks._memory import process_peak_mb


def in_own_process(work: Callable[[], Row]) -> Row:
    """The row, with the largest resident size of the process that measured it, libraries included."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(partial(_with_memory, work)).result()


def _with_memory(work: Callable[[], Row]) -> Row:
    return work() | {MEMORY: process_peak_mb()}
