"""What several processes that measure keyframes gain: the push-broom office by one and by two, in turn.

Run as ``python -m benchmarks.jobs``. Every run has a process of its own and has made a few keyframes before.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys

from benchmarks._measure import ONE_THREAD, PROJECT, Row
from benchmarks._table import plain

REPEATS, JOBS, SCANS = 5, (1, 2), 1200

_CODE = """
import hashlib, json, resource, sys, time
from slam.config import SlamConfig
from slam.runs.slam_run import run_slam
from slam.simulation import simulate_mission
from slam.timing import StageClock
jobs, scans = map(int, sys.argv[1:])
warm = simulate_mission("office", n_scans=60, seed=1)
run_slam(warm.log, warm.rig, SlamConfig())
mission, clock = simulate_mission("office", n_scans=scans, seed=0), StageClock()
def cpu():
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used)
before, start = cpu(), time.perf_counter()
run = run_slam(mission.log, mission.rig, SlamConfig(), jobs=jobs, clock=clock)
print(json.dumps({
    "wall": time.perf_counter() - start, "cpu": cpu() - before, "waiting": clock.seconds["measure"],
    "keyframes": len(run.trajectory), "bits": hashlib.sha256(run.trajectory.poses.tobytes()).hexdigest(),
}))
"""


def run(*, short: bool = False) -> list[Row]:
    """A row for every number of processes: the fastest of its runs, for other work on the machine only adds."""
    repeats, scans = (2, 300) if short else (REPEATS, SCANS)
    runs: dict[int, list[dict[str, float]]] = {jobs: [] for jobs in JOBS}
    for _ in range(repeats):
        for jobs in JOBS:
            runs[jobs].append(_run(jobs, scans))
    fastest = {jobs: min(one["wall"] for one in some) for jobs, some in runs.items()}
    return [
        {
            "what": f"office, {some[0]['keyframes']} keyframes",
            "processes": jobs,
            "s": fastest[jobs],
            "CPU s": min(one["cpu"] for one in some),
            "waiting for keyframes, s": min(one["waiting"] for one in some),
            "one process, x": fastest[JOBS[0]] / fastest[jobs],
            "same bits": all(one["bits"] == runs[JOBS[0]][0]["bits"] for one in some),
        }
        for jobs, some in runs.items()
    ]


def _run(jobs: int, scans: int) -> dict[str, float]:
    done = subprocess.run(
        [sys.executable, "-c", _CODE, str(jobs), str(scans)],
        env={**os.environ, **ONE_THREAD, "PYTHONPATH": str(PROJECT)},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(done.stderr.strip().splitlines()[-1])
    return json.loads(done.stdout)


def main() -> None:
    """Print the table."""
    print(plain(run()))


if __name__ == "__main__":
    main()
