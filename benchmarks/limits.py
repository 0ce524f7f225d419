"""The slowest stages beside what the hardware allows: moving the data at a bare copy's bandwidth, a bare loop of the
same arithmetic (`benchmarks._bare`), GTSAM alone with the same factors.

Run as ``python -m benchmarks.limits``. One thread, processor time, medians of repeats; a stage and its limits in turn.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import gtsam
import numpy as np

from benchmarks import _bare, fit, lines, scenes
from benchmarks._measure import CPU, PROJECT, Row, Task, in_turn
from benchmarks._table import plain
from spplanes import extract_lines, fit_plane
from spplanes._check import FloatArray
from spplanes.fitting.fit import Method

DATA = PROJECT.parent / "shared" / "data"
#: Numbers of the copy: far beyond every cache, 256 MB.
COPIED = 32_000_000


def bandwidth_gb_s() -> tuple[float, Row]:
    """Bytes moved a second, read and written, by the bare copy; and its row."""
    source, target = np.ones(COPIED), np.zeros(COPIED)
    (row,) = in_turn([Task("copy", lambda: _bare.copy(source, target), repeats=7)])
    speed = 2.0 * source.nbytes / row[CPU] / 1e6
    return speed, {"stage": "bare copy, 256 MB", "CPU ms": row[CPU], "limit": f"{speed:.1f} GB/s, read and written"}


def beside(
    stage: str, ours: Callable[[], Any], limits: dict[str, Callable[[], Any]], moved_mb: float, speed: float, times=1
) -> list[Row]:
    """Rows of a stage: itself, its limits, and the time to move its data as many times as a bare loop reads them."""
    tasks = [Task(stage, ours, repeats=5), *(Task(name, one, repeats=5) for name, one in limits.items())]
    measured = [row[CPU] for row in in_turn(tasks)]
    rows: list[Row] = [{"stage": stage, "CPU ms": measured[0], "limit": None}]
    found = dict(zip(limits, measured[1:], strict=True))
    if moved_mb:
        found[f"{moved_mb:.0f} MB read {times} times"] = times * moved_mb / speed
    for name, ms in found.items():
        rows.append({"stage": stage, "CPU ms": ms, "limit": name, "stage, x limit": measured[0] / ms})
    return rows


def fitting(speed: float) -> list[Row]:
    """A million points with covariances: a check, a start, and two steps ("ml") or sums of the covariance ("sp")."""
    points, covariances = fit.wall(fit.POINTS)
    frame, sums = np.eye(4), np.zeros(18)
    frame[:3, :3], frame[:3, 3] = np.column_stack([fit.X, fit.Y, fit.NORMAL]), fit.CENTRE

    def ml() -> None:
        _bare.check(points, covariances)
        _bare.start(points, covariances, sums)
        _bare.step(points, covariances, frame, sums)
        _bare.step(points, covariances, frame, sums)

    def sp() -> None:
        _bare.check(points, covariances)
        _bare.start(points, covariances, sums)
        _bare.spread(points, covariances, frame, sums)

    limits: dict[Method, dict[str, Callable[[], None]]] = {
        "ml": {"a bare check, start and two steps": ml},
        "sp": {"a bare check, start and covariance": sp},
    }
    moved, rows = (points.nbytes + covariances.nbytes) / 1e6, []
    for method, passes in zip(limits, (4, 3), strict=True):
        ours = partial(fit_plane, points, covariances, method=method)
        rows += beside(f"fit_plane, {method}, 1,000,000 points", ours, limits[method], moved, speed, passes)
    return rows


def bare_segmentation(points: FloatArray, covariances: FloatArray, eyes: FloatArray) -> Callable[[], None]:
    """The pass over a grid, and a start and two steps of the fit of all its points, as if they were on one plane."""
    sums, grid, planes = np.zeros((*points.shape[:2], 10)), np.zeros((512, 512), dtype=np.bool_), np.eye(4)[:2].copy()
    seen = np.isfinite(points[..., 0])
    flat, noise, frame, totals = points[seen], covariances[seen], np.eye(4), np.zeros(18)

    def work() -> None:
        _bare.segmentation(points, covariances, eyes, planes, sums, grid)
        _bare.start(flat, noise, totals)
        _bare.step(flat, noise, frame, totals)
        _bare.step(flat, noise, frame, totals)

    return work


def extraction(speed: float, n_scans: int) -> list[Row]:
    """The push-broom mission, and measuring a keyframe of a spinning lidar."""
    from benchmarks.tables import corridor_scans, points_of

    scans, name = points_of(corridor_scans(n_scans)), "a bare pass over the grid and a bare fit"
    bare = bare_segmentation(scans.points, scans.covariances, scans.viewpoints)
    moved = (scans.points.nbytes + scans.covariances.nbytes) / 1e6
    stage = f"segment_scans, mission of {n_scans} scans"
    return beside(stage, scenes.mission(n_scans).segment, {name: bare}, moved, speed, 4) + measuring(name, speed)


def measuring(name: str, speed: float) -> list[Row]:
    """Scans of 64 x 1172 beams to the planes of a keyframe each."""
    from benchmarks.keyframe import SENSOR, spinning_hall
    from slam import SlamConfig
    from slam.frontend.keyframes import keyframes_of
    from slam.frontend.measurement import model_of
    from slam.sensors.log import CloudScan

    scene = spinning_hall(3)
    grids = [scan.points for scan in scene.log.scans() if isinstance(scan, CloudScan)]
    model = model_of(scene.rig.sensors[SENSOR])
    bare = [bare_segmentation(grid, model.covariances(grid), np.zeros((len(grid), 3))) for grid in grids]
    moved = sum(12 * grid.nbytes / 3 for grid in grids) / 1e6
    stage = f"measure, {len(grids)} keyframes of {grids[0].shape[0]} x {grids[0].shape[1]}"
    ours = partial(lambda: list(keyframes_of(scene.log, scene.rig, SlamConfig())))
    return beside(stage, ours, {name: lambda: [one() for one in bare]}, moved, speed, 4)


def scan_lines() -> list[Row]:
    """Lines of a hundred scans."""
    scans = lines.simulated("rooms", "361 beams, 180 deg", 0.01)
    full = [(np.nan_to_num(scan.ranges, nan=5.0), scan.angles, np.empty(scan.angles.size)) for scan in scans]
    limits = {"a bare pass of its sums and fits": lambda: [_bare.lines(r, a, 0.01, cost) for r, a, cost in full]}
    ours = partial(lambda: [extract_lines(scan.ranges, scan.angles, sigma=scan.sigma) for scan in scans])
    return beside(f"extract_lines, {len(scans)} scans of 361 beams", ours, limits, 0.0, 1.0)


def estimation(name: str) -> list[Row]:
    """The estimator over a log beside iSAM2 alone that is given the same factors in the same order."""
    from slam import PlaneSlam, SlamConfig
    from slam.backend.estimator import Backend
    from slam.frontend.keyframes import keyframes_of
    from slam.io.load import load

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
    rows = [row, *fitting(speed), *extraction(speed, 344 if short else 1083), *scan_lines()]
    return rows + (estimation("loop5/loop5.clf.gz") if (DATA / "loop5").is_dir() else [])


def main() -> None:
    """Print the table."""
    print(plain(run()))


if __name__ == "__main__":
    main()
