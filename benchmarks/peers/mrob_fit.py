"""Peer of `benchmarks.fit`, run by the peers' interpreter: reads groups of points (K, n, 3), prints JSON."""

import json
import sys
import time

import mrob  # type: ignore[import-not-found]  # a peer, in an environment of its own
import numpy as np

from benchmarks._memory import peak_mb


def fits(groups):
    """Plane (n, d) of each group with n.x + d = 0."""
    return [mrob.estimate_plane(points) for points in groups]


def median_ms(groups, repeats):
    """Median processor and wall time of all fits, ms."""
    fits(groups)
    taken = []
    for _ in range(repeats):
        cpu, wall = time.process_time(), time.perf_counter()
        fits(groups)
        taken.append((time.process_time() - cpu, time.perf_counter() - wall))
    return 1e3 * np.median(taken, axis=0)


if __name__ == "__main__":
    points = np.load(sys.argv[1])["points"]
    cpu_ms, wall_ms = median_ms(points, int(sys.argv[2]))
    row = {"CPU ms": cpu_ms, "wall ms": wall_ms, "peak memory MB": peak_mb(lambda: fits(points))}
    row["planes"] = [np.ravel(plane).tolist() for plane in fits(points)]
    print(json.dumps(row))
