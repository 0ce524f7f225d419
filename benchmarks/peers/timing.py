"""Time and memory of a peer's call, as its own interpreter measures them."""

import time

import numpy as np

from benchmarks._memory import peak_mb


def measured(work, repeats):
    """What a call returns, and its row: median processor and wall time after once to warm up, and peak memory."""
    found, taken = work(), []
    for _ in range(int(repeats)):
        cpu, wall = time.process_time(), time.perf_counter()
        work()
        taken.append((time.process_time() - cpu, time.perf_counter() - wall))
    cpu_ms, wall_ms = 1e3 * np.median(taken, axis=0)
    return found, {"CPU ms": cpu_ms, "wall ms": wall_ms, "peak memory MB": peak_mb(work)}
