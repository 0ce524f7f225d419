"""Cost of the factors beside GTSAM's own, in one run; those of mrob are in ``benchmarks.views``.

Run as ``python -m benchmarks.factors``. One thread, CPU time; medians of repeats, kernels warmed up.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import gtsam
import numpy as np

from benchmarks._factor_scenes import plane_key, pose_key, random_frames, random_poses, walk
from factors import line_factor, plane_factor, plane_factors, plane_landmark
from factors._conventions import square_root_informations
from spplanes import Plane, ScanLine

REPEATS = 7


def timed(task: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Median CPU seconds of a few calls after one to warm up."""
    task()
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        task()
        seconds.append(time.process_time() - start)
    return float(np.median(seconds))


def stock_factors(planes: list[Plane], poses: list[int], keys: list[int]) -> gtsam.NonlinearFactorGraph:
    """The wheel's OrientedPlane3Factor with the same noise."""
    graph = gtsam.NonlinearFactorGraph()
    roots = square_root_informations(np.stack([p.frame for p in planes]), np.stack([p.covariance for p in planes]))
    for plane, root, pose, key in zip(planes, roots, poses, keys, strict=True):
        noise = gtsam.noiseModel.Gaussian.SqrtInformation(root)
        graph.push_back(gtsam.OrientedPlane3Factor(np.array([*plane.normal, -plane.d]), noise, pose, key))
    return graph


def linearisation() -> list[dict[str, Any]]:
    """Microseconds to linearise one factor, in a graph of 3,000."""
    rng, n = np.random.default_rng(0), 3000
    values = gtsam.Values()
    for i, pose in enumerate(random_poses(rng, 100)):
        values.insert(pose_key(i), pose)
    frames = random_frames(rng, 30)
    planes = [Plane(frames[k % 30], np.diag([0.005, 0.002, 0.01]) ** 2) for k in range(n)]
    for j in range(30):
        values.insert(plane_key(j), plane_landmark(planes[j]))
    poses, keys = [pose_key(1 + k % 99) for k in range(n)], [plane_key(k // 99 % 30) for k in range(n)]
    anchors = [pose_key(0)] * n
    mount, covariance = np.eye(4), np.diag([0.005, 0.01]) ** 2
    line = ScanLine(0.3, 2.0, covariance, np.zeros((2, 2)), np.arange(2))
    lines, lines_world, lines_native = (gtsam.NonlinearFactorGraph() for _ in range(3))
    upright = gtsam.OrientedPlane3(1.0, 0.0, 0.0, -2.0)
    for pose, key in zip(poses, keys, strict=True):
        lines.push_back(line_factor(line, mount, pose, key, anchor_key=pose_key(0)))
        lines_world.push_back(line_factor(line, mount, pose, key))
        lines_native.push_back(line_factor(line, mount, pose, key, anchor_key=pose_key(0), expected=upright))
    graphs = {
        "stock OrientedPlane3Factor": stock_factors(planes, poses, keys),
        "plane_factor, anchored (native)": plane_factors(planes, poses, keys, anchors),
        "plane_factor, world (compiled)": plane_factors(planes, poses, keys),
        "plane_factor, own anchor (compiled)": plane_factors(planes, poses, keys, poses),
        "line_factor, anchored, expected (native)": lines_native,
        "line_factor, anchored (compiled)": lines,
        "line_factor, world (compiled)": lines_world,
    }
    times = {name: timed(lambda graph=graph: graph.linearize(values)) / n for name, graph in graphs.items()}
    stock = times["stock OrientedPlane3Factor"]
    rows = [{"what": f"linearise {name}", "us": 1e6 * t, "ratio": t / stock} for name, t in times.items()]
    many = timed(lambda: plane_factors(planes, poses, keys, anchors)) / n
    observations = list(zip(planes, poses, keys, strict=True))
    one = timed(lambda: [plane_factor(p, a, b, anchor_key=pose_key(0)) for p, a, b in observations]) / n
    stock_build = timed(lambda: stock_factors(planes, poses, keys)) / n
    for name, t in (("stock, roots in bulk", stock_build), ("plane_factors", many), ("plane_factor, one by one", one)):
        rows.append({"what": f"build {name}", "us": 1e6 * t, "ratio": t / stock_build})
    return rows


def callbacks() -> list[dict[str, Any]]:
    """What a custom factor costs inside an optimiser, by number of variables: every call copies all values."""
    rows = []
    line = ScanLine(0.3, 2.0, np.diag([0.005, 0.01]) ** 2, np.zeros((2, 2)), np.arange(2))
    wall = gtsam.OrientedPlane3(1.0, 0.0, 0.0, -2.0)
    for n in (100, 1000, 5000):
        seconds = {}
        for form, expected in (("none", None), ("native", wall), ("compiled", None)):
            graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
            for i in range(n):
                values.insert(pose_key(i), gtsam.Pose3())
                graph.addPriorPose3(pose_key(i), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 0.1))
            values.insert(plane_key(0), wall)
            graph.push_back(
                gtsam.OrientedPlane3DirectionPrior(
                    plane_key(0), np.array([1.0, 0, 0, 0]), gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
                )
            )
            graph.push_back(
                line_factor(line, np.eye(4), pose_key(1), plane_key(0), anchor_key=pose_key(0), expected=wall)
            )
            for i in range(2, 100):
                if form != "none":
                    graph.push_back(
                        line_factor(
                            line, np.eye(4), pose_key(i), plane_key(0), anchor_key=pose_key(0), expected=expected
                        )
                    )
            seconds[form] = timed(
                lambda graph=graph, values=values: gtsam.GaussNewtonOptimizer(graph, values).iterate(), 5
            )
        for form in ("native", "compiled"):
            us = 1e6 * (seconds[form] - seconds["none"]) / 98
            rows.append({"what": f"one Gauss-Newton step of one line, {form}, {n} values", "us": us})
    return rows


def batch(name: str, sigmas: np.ndarray) -> list[dict[str, Any]]:
    """The same graph of 1,000 poses, 200 planes and 6,000 observations with stock factors and with ours."""
    odometry, poses, seen = walk(sigmas)
    planes = [plane for _, _, plane in seen]
    pose_keys, plane_keys = [pose_key(i) for i, _, _ in seen], [plane_key(j) for _, j, _ in seen]
    first: dict[int, int] = {}
    for i, j, _ in seen:
        first.setdefault(j, i)
    # a few anchors for all, each some 15 poses from the first observer; the observer itself would be a custom factor
    shared = {j: min(15 + 30 * (i // 30) + (i % 30 == 15), 999) for j, i in first.items()}
    forms: dict[str, dict[int, int] | None] = {
        "ours, shared anchors": shared,
        "ours, first observer": first,
        "ours, world": None,
    }
    graphs: dict[str, tuple[gtsam.NonlinearFactorGraph, dict[int, int] | None]] = {
        "stock": (stock_factors(planes, pose_keys, plane_keys), None)
    }
    for form, anchors in forms.items():
        anchor_keys = None if anchors is None else [pose_key(anchors[j]) for _, j, _ in seen]
        graphs[form] = plane_factors(planes, pose_keys, plane_keys, anchor_keys), anchors
    rows = []
    for form, (factors, anchors) in graphs.items():
        graph, values = gtsam.NonlinearFactorGraph(odometry), gtsam.Values(poses)
        graph.push_back(factors)
        for i, j, plane in seen:
            if first[j] == i:
                landmark = plane_landmark(plane, poses.atPose3(pose_key(i)))
                anchor = gtsam.Pose3() if anchors is None else poses.atPose3(pose_key(anchors[j]))
                values.insert(plane_key(j), landmark.transform(anchor))
        rows.append({"what": f"batch {name}, {form}", **optimised(graph, values)})
    return [{**row, "ratio": row["ms"] / rows[0]["ms"]} for row in rows]


def optimised(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> dict[str, Any]:
    """Time, iterations and chi2 per degree of freedom of a Levenberg-Marquardt run."""
    solver = gtsam.LevenbergMarquardtOptimizer(graph, values)
    result = solver.optimize()
    seconds = timed(lambda: gtsam.LevenbergMarquardtOptimizer(graph, values).optimize(), repeats=3)
    dof = sum(graph.at(i).dim() for i in range(graph.size())) - result.dim()
    return {"ms": 1e3 * seconds, "iterations": solver.iterations(), "chi2/dof": 2.0 * graph.error(result) / dof}


def run() -> list[dict[str, Any]]:
    """All rows; ``ratio`` is to the first row of its kind."""
    tilted = batch("1:5 tilts", np.array([0.005, 0.002, 0.01]))
    return linearisation() + callbacks() + tilted + batch("equal tilts", np.array([0.005, 0.005, 0.005]))


def main() -> None:
    """Print the table."""
    for row in run():
        rest = "  ".join(f"{k} {v:.4g}" for k, v in row.items() if k != "what")
        print(f"{row['what']:48s} {rest}")


if __name__ == "__main__":
    main()
