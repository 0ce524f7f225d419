"""The slowest stages beside what the hardware allows: moving the data at a bare copy's bandwidth, a bare loop of the
same arithmetic, GTSAM alone with the same factors.

Run as ``python -m benchmarks.limits``. One thread, processor time, medians of repeats; a stage and its limits in turn.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
from numba import njit

from benchmarks import fit, scenes
from benchmarks._measure import CPU, PROJECT, Row, Task, in_turn
from benchmarks._table import plain
from spplanes import fit_plane

DATA = PROJECT.parent / "shared" / "data"
#: Numbers of the copy: far beyond every cache, 256 MB.
COPIED = 32_000_000


@njit(cache=True)
def bare_copy(source: np.ndarray, target: np.ndarray) -> None:
    """One number after the other."""
    for k in range(source.size):
        target[k] = source[k]


@njit(cache=True)
def bare_moments(points: np.ndarray, covariances: np.ndarray, n: np.ndarray, sums: np.ndarray) -> None:
    """One pass of a fit: weight 1/(n^T C n), weighted moments of a point to second order."""
    sums[:] = 0.0
    for k in range(len(points)):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if np.isnan(x):
            continue
        c = covariances[k]
        variance = n[0] * (c[0, 0] * n[0] + 2.0 * (c[0, 1] * n[1] + c[0, 2] * n[2]))
        variance += n[1] * (c[1, 1] * n[1] + 2.0 * c[1, 2] * n[2]) + n[2] * c[2, 2] * n[2]
        w = 1.0 / variance
        sums[0] += w
        sums[1] += w * x
        sums[2] += w * y
        sums[3] += w * z
        sums[4] += w * x * x
        sums[5] += w * x * y
        sums[6] += w * x * z
        sums[7] += w * y * y
        sums[8] += w * y * z
        sums[9] += w * z * z


def bandwidth_gb_s() -> tuple[float, Row]:
    """Bytes moved a second, read and written, by the bare copy; and its row."""
    source, target = np.ones(COPIED), np.zeros(COPIED)
    (row,) = in_turn([Task("copy", lambda: bare_copy(source, target), repeats=7)])
    speed = 2.0 * source.nbytes / row[CPU] / 1e6
    return speed, {"stage": "bare copy, 256 MB", "CPU ms": row[CPU], "limit": f"{speed:.1f} GB/s, read and written"}


def beside(stage: str, ours: Callable[[], Any], limits: dict[str, Callable[[], Any]], moved_mb: float, speed: float):
    """Rows of a stage: itself, its limits, and the time to move its data once."""
    tasks = [Task(stage, ours, repeats=3), *(Task(name, one, repeats=5) for name, one in limits.items())]
    measured = [row[CPU] for row in in_turn(tasks)]
    rows: list[Row] = [{"stage": stage, "CPU ms": measured[0], "limit": None}]
    for name, ms in zip(limits, measured[1:], strict=True):
        rows.append({"stage": stage, "CPU ms": ms, "limit": name, "stage, x limit": measured[0] / ms})
    if moved_mb:
        ms = moved_mb / speed
        rows.append(
            {"stage": stage, "CPU ms": ms, "limit": f"{moved_mb:.0f} MB moved once", "stage, x limit": measured[0] / ms}
        )
    return rows


def fitting(speed: float) -> list[Row]:
    """A million points with covariances."""
    points, covariances = fit.wall(fit.POINTS)
    sums = np.zeros(10)
    limits = {
        "one bare pass of weights and moments": lambda: bare_moments(points, covariances, fit.NORMAL, sums),
    }
    moved = (points.nbytes + covariances.nbytes) / 1e6
    return [
        row
        for method in ("ml", "sp")
        for row in beside(
            f"fit_plane, {method}", lambda m=method: fit_plane(points, covariances, method=m), limits, moved, speed
        )
    ]


def extraction(speed: float, n_scans: int) -> list[Row]:
    """The push-broom mission."""
    from benchmarks.tables import corridor_scans, points_of

    mission = corridor_scans(n_scans)
    scans = points_of(mission)
    scene = scenes.mission(n_scans)
    points, covariances = scans.points.reshape(-1, 3), scans.covariances.reshape(-1, 3, 3)
    sums, normal = np.zeros(10), np.array([0.0, 0.0, 1.0])
    limits = {
        "one bare pass of weights and moments": lambda: bare_moments(points, covariances, normal, sums),
    }
    moved = (points.nbytes + covariances.nbytes) / 1e6
    return beside(f"segment_scans, mission of {n_scans} scans", scene.segment, limits, moved, speed)


def estimation(name: str) -> list[Row]:
    """The estimator over a log beside iSAM2 alone that is given the same factors in the same order."""
    from slam import PlaneSlam, SlamConfig
    from slam.backend import Backend
    from slam.io.load import load
    from slam.keyframes import keyframes_of

    log, rig = load(DATA / name)
    frames = list(keyframes_of(log, rig, SlamConfig()))
    updates: list[tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[int], bool]] = []

    def whole() -> None:
        slam = PlaneSlam(SlamConfig())
        for frame in frames:
            slam.add_keyframe(frame)

    original = Backend.update

    def recorded(self: Backend, factors: Any, initial: gtsam.Values, remove: Any = (), *, relinearize: bool = False):
        factors, graph = list(factors), gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.push_back(factor)
        updates.append((graph, gtsam.Values(initial), list(remove), relinearize))
        return original(self, factors, initial, remove, relinearize=relinearize)

    Backend.update = recorded  # type: ignore[method-assign]
    try:
        whole()
    finally:
        Backend.update = original  # type: ignore[method-assign]

    def alone() -> None:
        isam = gtsam.ISAM2(Backend(SlamConfig().backend)._parameters)
        for graph, initial, remove, relinearize in updates:
            isam.update(graph, initial, remove)
            if relinearize:
                isam.update()

    words = f"iSAM2 alone, its {len(updates)} updates of {len(frames)} keyframes"
    return beside(f"estimate, {name.split('/')[0]}", whole, {words: alone}, 0.0, 1.0)


def run(*, short: bool = False) -> list[Row]:
    """Rows of the stages and their limits."""
    speed, row = bandwidth_gb_s()
    rows = [row, *fitting(speed), *extraction(speed, 344 if short else 1083)]
    return rows + (estimation("loop5/loop5.clf.gz") if (DATA / "loop5").is_dir() else [])


def main() -> None:
    """Print the table."""
    print(plain(run()))


if __name__ == "__main__":
    main()
