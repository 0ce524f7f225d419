"""Simulated missions with truth, poses unknown: how good, and how honest, over many seeds.

`python -m benchmarks.missions [RUNS [SCANS]]`: the corridor; `python -m benchmarks.missions office [RUNS [FIRST]]`: two
laps of an office of 79 m with rooms, seeds from FIRST on. A run of the office takes minutes: each row is printed as it
comes.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator

import gtsam
import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import chi2

from slam.config import SlamConfig
from slam.demo import in_frame_of_truth
from slam.evaluation import absolute_error, match_planes, plane_metrics
from slam.frames import inverse
from slam.planeslam import pose_symbol
from slam.run import Run, run_slam
from slam.simulation import Mission, Truth, simulate_mission

#: Tangent of Pose3 in the floor plane: yaw, x, y.
IN_PLANE = [2, 3, 4]


def run(runs: int = 20, scans: int = 400) -> list[dict]:
    """One row a seed."""
    return [_row(seed, scans) for seed in range(runs)]


def run_office(runs: int = 10, first: int = 0) -> Iterator[dict]:
    """One row a seed: two laps."""
    for seed in range(first, first + runs):
        yield _measured(seed, simulate_mission("office", laps=2, seed=seed))


def _row(seed: int, scans: int) -> dict:
    return _measured(seed, simulate_mission("corridor", n_scans=scans, seed=seed))


def _measured(seed: int, mission: Mission) -> dict:
    start = time.perf_counter()
    done = run_slam(mission.log, mission.rig, SlamConfig())
    seconds = time.perf_counter() - start
    truth = mission.truth
    planes = in_frame_of_truth(done, truth.trajectory)
    matches = match_planes(planes, truth.planes)
    shares = {row.name: row.value for row in plane_metrics(planes, truth.planes, visible=truth.visible_in_3d())}
    return {
        "seed": seed,
        "position rmse, m": _rmse(done, truth),
        "odometry rmse, m": _rmse(done, truth, odometry=True),
        "pose NEES (3)": _pose_nees(done, truth),
        "plane NEES, mean (3)": float(np.mean([match.nees for match in matches])),
        "plane NEES, median (2.37)": float(np.median([match.nees for match in matches])),
        "plane distance, median, m": shares["plane distance median"],
        "plane angle, median, deg": shares["plane angle median"],
        "duplicates, %": shares["planes duplicate"],
        "missed, %": shares["planes missed"],
        "s per keyframe": seconds / len(done.trajectory),
    }


def _rmse(done: Run, truth: Truth, *, odometry: bool = False) -> float:
    path = done.odometry if odometry else done.trajectory
    return float(np.sqrt(np.mean(absolute_error(path, truth.trajectory, alignment="first").translation_m ** 2)))


def _pose_nees(done: Run, truth: Truth) -> float:
    """NEES of the last pose in the floor plane, relative to the first, whose own covariance is the prior's."""
    true = truth.poses_at(done.trajectory.stamps_ns)
    relative = inverse(true[0]) @ true[-1]
    error = gtsam.Pose3.Logmap(
        gtsam.Pose3(inverse(relative) @ inverse(done.trajectory.poses[0]) @ done.trajectory.poses[-1])
    )
    covariance = done.slam.marginal_covariance(pose_symbol(len(true) - 1))[np.ix_(IN_PLANE, IN_PLANE)]
    return float(error[IN_PLANE] @ np.linalg.solve(covariance, error[IN_PLANE]))


def main() -> None:
    """Print the rows, their medians, and the band that the mean pose NEES should lie in."""
    arguments = [int(word) for word in sys.argv[1:4] if word.isdigit()]
    world = "office" if "office" in sys.argv[1:2] else "corridor"
    rows = []
    for row in run_office(*arguments) if world == "office" else run(*arguments):
        rows.append(row)
        if world == "office":
            print(", ".join(f"{name} {value:.3g}" for name, value in row.items()), flush=True)
    table = Table(title=f"{world} missions, poses unknown")
    for name in rows[0]:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*(f"{value:.3g}" for value in row.values()))
    table.add_row("median", *(f"{np.median([row[name] for row in rows]):.3g}" for name in list(rows[0])[1:]))
    Console(width=180).print(table)
    low, high = chi2.ppf([0.025, 0.975], 3 * len(rows)) / len(rows)
    mean = np.mean([row["pose NEES (3)"] for row in rows])
    print(f"mean pose NEES {mean:.2f}, 95 % band of {len(rows)} runs {low:.2f} to {high:.2f}")


if __name__ == "__main__":
    main()
