"""The cores there are, for kernels that release Python's lock; results are the same bits whatever their number.

Python's own threads and not numba's, whose pools end the process where it forks or where two threads call at a time.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise

from numba import config

#: Fewest points for which a second thread is worth waking, of each thread.
LEAST = 1 << 15

_lock, _pool, _alone = threading.Lock(), None, False


def available() -> int:
    """Threads to use: the cores this process may run on, at most NUMBA_NUM_THREADS."""
    most = config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]
    if most < 2 or _alone:
        return 1  # without asking the system, which takes its time
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(min(cores, most), 1)


def stay_alone() -> None:
    """One thread from here on: for a process that is one of several which share the cores."""
    global _alone
    _alone = True


def threads_for(size: int) -> int:
    """Threads that work on so many points is worth."""
    return min(available(), size // LEAST) if size >= 2 * LEAST else 1


def in_parts(work: Callable[[int, int], object], count: int, size: int, *, singly: bool = False) -> None:
    """Call ``work(first, last)`` for parts of ``range(count)``, all of it once, on as many threads as are worth it.

    `work` releases Python's lock; what it does for one number depends on no other number, nor does where it writes. All
    numbers together stand for `size` points. Where some take far longer than others they come first, and `singly`.
    """
    threads = min(threads_for(size), count)
    if threads < 2:
        work(0, count)
        return
    parts = count if singly else min(4 * threads, count)  # so that no thread waits long for another
    bounds = [count * k // parts for k in range(parts + 1)]
    left = iter(list(pairwise(bounds)))  # one for all: each thread takes the next part

    def take() -> None:
        for first, last in left:
            work(first, last)

    helpers = []
    try:
        for _ in range(threads - 1):
            helpers.append(_threads().submit(take))
    except RuntimeError:
        pass  # no thread to be had, as while Python ends: those there are do it all
    try:
        take()
    finally:
        wait(helpers)  # also when interrupted: nobody writes to arrays that the caller has back
    for helper in helpers:
        helper.result()


def _threads() -> ThreadPoolExecutor:
    """The pool, made when first needed."""
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(max(available() - 1, 1), thread_name_prefix="spplanes")
        return _pool


def _forget() -> None:
    """Threads stay behind where a process forks; the child makes its own."""
    global _lock, _pool
    _lock, _pool, _alone = threading.Lock(), None, False


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
