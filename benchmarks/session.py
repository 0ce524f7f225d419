"""What a session costs: the share of a run that goes into it.

`python -m benchmarks.session [REPEATS]`
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from rich.console import Console
from rich.table import Table

from slam import SlamConfig
from slam.output.run_folder import Source, new_run
from slam.runs.slam_run import run_slam
from slam.sensors.log import Log
from slam.sensors.rig import Rig
from slam.session.recorder import Recorder
from slam.session.replay import RawScans
from slam.simulation import simulate_mission
from slam.simulation.rigs import VERTICAL

#: Name, world, scans, and whether the robot has its push-broom laser: with lines alone keyframes are cheapest.
MISSIONS = (
    ("corridor", "corridor", 150, True),
    ("office, lines alone", "office", 400, False),
    ("office, lines alone, longer", "office", 2000, False),
)


def run(repeats: int = 3) -> list[dict]:
    """One row a mission and way of keeping raw scans: the session's share of the run's time."""
    rows = []
    for name, world, scans, broom in MISSIONS:
        mission = simulate_mission(world, n_scans=scans, seed=0)
        sensors = {key: one for key, one in mission.rig.sensors.items() if broom or key != VERTICAL}
        rig = Rig(sensors=sensors, odometry=mission.rig.odometry)
        for raw in ("reference", "value"):
            rows.append({"mission": name, "raw scans": f"by {raw}", **_row(mission.log, rig, raw, repeats)})
    return rows


def _row(log: Log, rig: Rig, raw: RawScans, repeats: int) -> dict:
    """The share is of one and the same run: what the session's own calls took of it, the wait for the disk included.

    Processor time is told beside it: on a machine that does other things the wait for the disk is that for its turn.
    """
    shares, busy, spent, size, count = [], [], [], 0, 0
    for _ in range(repeats + 1):  # the first warms the kernels up
        with tempfile.TemporaryDirectory(prefix="spplanes-session-") as folder:
            source = Path(folder) / "log"
            source.write_bytes(b"")
            out, watch = Path(folder) / "run", _Watch()
            start, start_cpu = time.perf_counter(), time.process_time()
            with new_run(out, log, rig, SlamConfig(), Source(source, raw=raw), prior=None, overwrite=False) as slam:
                watch.listen_to(slam.recorder)
                opened, opened_cpu = time.perf_counter() - start, time.process_time() - start_cpu
                run_slam(log, rig, slam.config, slam=slam)
                count, done, done_cpu = len(slam.keyframes), time.perf_counter(), time.process_time()
            end, end_cpu = time.perf_counter(), time.process_time()
            spent.append(watch.seconds + opened + end - done)
            shares.append(spent[-1] / (end - start - spent[-1]))
            spent_cpu = watch.cpu_seconds + opened_cpu + end_cpu - done_cpu
            busy.append(spent_cpu / (end_cpu - start_cpu - spent_cpu))
            size = (out / "session.db").stat().st_size
    return {
        "keyframes": count,
        "share of the rest, %": 100.0 * median(shares[1:]),
        "of its CPU, %": 100.0 * median(busy[1:]),
        "ms per keyframe": 1e3 * median(spent[1:]) / count,
        "kB per keyframe": size / count / 1e3,
    }


class _Watch:
    """Time inside the calls of a recorder, wall and processor, s."""

    def __init__(self) -> None:
        self.seconds = self.cpu_seconds = 0.0

    def listen_to(self, recorder: Recorder) -> None:
        """Put a clock round its two calls."""
        for name in ("measured", "decided"):
            setattr(recorder, name, self._timed(getattr(recorder, name)))

    def _timed(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*arguments: Any) -> Any:
            start, start_cpu = time.perf_counter(), time.process_time()
            try:
                return call(*arguments)
            finally:
                self.seconds += time.perf_counter() - start
                self.cpu_seconds += time.process_time() - start_cpu

        return timed


def main() -> None:
    """Print the table."""
    rows = run(*(int(word) for word in sys.argv[1:2]))
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(f"{value:.3g}" if isinstance(value, float) else str(value) for value in row.values()))
    Console().print(table)


if __name__ == "__main__":
    main()
