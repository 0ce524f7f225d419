"""Speed and memory of the plane fits beside plain numpy and the uncertainty-free fits of Open3D and mrob.

Run as ``python -m benchmarks.fit``. One thread; medians of the CPU time of repeats, kernels warmed up; all rows in one
run. CPU time, so that a busy machine does not decide; it still slows what waits for memory.
mrob needs numpy < 2 and so an interpreter of its own, ``.peers/mrob/bin/python`` or ``$MROB_PYTHON``.
"""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
import tracemalloc
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from spplanes import fit_plane, fit_planes

POINTS = 1_000_000
PLANES, PER_PLANE = 10_000, 100
REPEATS = 5


def wall(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) and covariances (n, 3, 3) of an oblique wall seen by a laser: range noise 15 mm, across 2 mrad."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([4.0 + rng.uniform(-1, 1, n), rng.uniform(-2, 2, n), rng.uniform(-1, 1, n)])
    points[:, 1] += points[:, 0]
    ranges = np.linalg.norm(points, axis=1)
    beams = points / ranges[:, None]
    along = beams[:, :, None] * beams[:, None, :]
    covariances = 0.015**2 * along + ((0.002 * ranges) ** 2)[:, None, None] * (np.eye(3) - along)
    flat = np.column_stack([rng.uniform(-2, 2, n), rng.uniform(-1, 1, n)])
    x, y = np.array([0.6, 0.8, 0.0]), np.array([0.0, 0.0, 1.0])
    points = np.array([4.0, 1.0, 0.2]) + flat[:, :1] * x + flat[:, 1:] * y
    return points + 0.015 * rng.normal(size=(n, 1)) * beams, covariances


def sp_numpy(points: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The formulas of ``method="sp"`` in straightforward numpy: normal and covariance."""
    w = 1.0 / np.trace(covariances, axis1=1, axis2=2) ** 2
    centre = w @ points / w.sum()
    q = points - centre
    values, axes = np.linalg.eigh((w[:, None] * q).T @ q)
    n, y, x = axes[:, 0], axes[:, 1], axes[:, 2]
    local = q @ axes
    rows = np.stack([np.broadcast_to(n, q.shape), *(np.outer(local[:, k], n) for k in (2, 1))], axis=1)
    rows[:, 1] += np.outer(local[:, 0], x)
    rows[:, 2] += np.outer(local[:, 0], y)
    middle = np.einsum("n,nij,njk,nlk->il", w * w, rows, covariances, rows, optimize=True)
    scale = np.array([1.0 / w.sum(), -1.0 / (values[2] - values[0]), 1.0 / (values[1] - values[0])])
    return n, scale[:, None] * middle * scale


def ml_numpy(points: np.ndarray, covariances: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The formulas of ``method="ml"`` in straightforward numpy: normal and covariance."""
    w = 1.0 / np.trace(covariances, axis1=1, axis2=2)
    origin = w @ points / w.sum()
    q = points - origin
    axes = np.linalg.eigh((w[:, None] * q).T @ q)[1][:, ::-1]
    while True:
        local = (points - origin) @ axes
        noise = np.einsum("ji,njk,kl->nil", axes, covariances, axes, optimize=True)
        w = 1.0 / noise[:, 2, 2]
        feet = local - noise[:, :, 2] * (w * local[:, 2])[:, None]
        h = np.column_stack([np.ones(len(points)), feet[:, :2]])
        information, gradient = h.T @ (w[:, None] * h), h.T @ (w * local[:, 2])
        b = np.linalg.solve(information, gradient)
        if b @ gradient < 1e-10:
            break
        origin = origin + b[0] * axes[:, 2]
        axes = np.linalg.qr(np.column_stack([axes[:, 2] - axes[:, :2] @ b[1:], axes[:, :2]]))[0][:, [1, 2, 0]]
    along = noise[:, :2, :2] - np.einsum("ni,nj,n->nij", noise[:, :2, 2], noise[:, :2, 2], w)
    curvature = information.copy()
    curvature[1:, 1:] -= np.einsum("n,nij->ij", w, along)
    inverse = np.linalg.inv(curvature)
    return axes[:, 2], inverse @ information @ inverse


def open3d_plane(points: np.ndarray) -> np.ndarray:
    """Plane normal by Open3D's mean and covariance of a cloud, which it has to be copied to."""
    import open3d

    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    return np.linalg.eigh(cloud.compute_mean_and_covariance()[1])[1][:, 0]


_MROB = """
import sys, time, mrob, numpy as np
points, seconds = np.load(sys.argv[1]), []
for _ in range(int(sys.argv[2]) + 1):
    start = time.process_time()
    mrob.estimate_plane(points)
    seconds.append(time.process_time() - start)
print(np.median(seconds[1:]))
"""


def mrob_rows(points: np.ndarray) -> list[dict[str, Any]]:
    """The row of mrob's fit, by an interpreter of its own (numpy < 2); none where there is none."""
    default = Path(__file__).resolve().parent.parent / ".peers" / "mrob" / "bin" / "python"
    python = Path(os.environ.get("MROB_PYTHON", default))
    if not python.exists():
        return []
    with tempfile.TemporaryDirectory() as folder:
        np.save(Path(folder) / "points.npy", points)
        command = [str(python), "-c", _MROB, str(Path(folder) / "points.npy"), str(REPEATS)]
        done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    speed = len(points) / float(done.stdout) / 1e6
    return [{"fit": "mrob, no covariance", "points": len(points), "Mpoints/s": speed, "peak/input": float("nan")}]


def measure(task: Callable[[], Any]) -> tuple[float, int]:
    """Median CPU seconds of a task, warmed up, and the peak of the memory it allocates, bytes."""
    task()
    seconds = []
    for _ in range(REPEATS):
        start = time.process_time()
        task()
        seconds.append(time.process_time() - start)
    tracemalloc.start()
    task()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return float(np.median(seconds)), peak


def tasks() -> list[tuple[str, int, int, Callable[[], Any]]]:
    """Name, points, bytes of input and task of every row."""
    points, covariances = wall(POINTS)
    many, labels = PLANES * PER_PLANE, np.repeat(np.arange(PLANES), PER_PLANE)
    shuffled = np.random.default_rng(1).permutation(labels)
    both = points.nbytes + covariances.nbytes
    rows: list[tuple[str, int, int, Callable[[], Any]]] = [
        ("sp, numpy", POINTS, both, partial(sp_numpy, points, covariances)),
        ("sp", POINTS, both, partial(fit_plane, points, covariances, method="sp")),
        ("ml, numpy", POINTS, both, partial(ml_numpy, points, covariances)),
        ("ml", POINTS, both, partial(fit_plane, points, covariances)),
        ("ml, one sigma", POINTS, points.nbytes, partial(fit_plane, points, sigma=0.015)),
        ("ml, tukey", POINTS, both, partial(fit_plane, points, covariances, robust="tukey")),
        ("ml, 10,000 planes", many, both, partial(fit_planes, points, covariances, labels)),
        ("ml, 10,000 planes, shuffled", many, both, partial(fit_planes, points, covariances, shuffled)),
        ("sp, 10,000 planes", many, both, partial(fit_planes, points, covariances, labels, method="sp")),
    ]
    if find_spec("open3d"):
        rows.append(("open3d, no covariance", POINTS, points.nbytes, partial(open3d_plane, points)))
    return rows


def run() -> list[dict[str, Any]]:
    """One row for each fit: million points a second, ratio to numpy's ml, peak memory in copies of the input."""
    rows = []
    for name, n, size, task in tasks():
        seconds, peak = measure(task)
        rows.append({"fit": name, "points": n, "Mpoints/s": n / seconds / 1e6, "peak/input": peak / size})
    rows += mrob_rows(wall(POINTS)[0])
    reference = next(row["Mpoints/s"] for row in rows if row["fit"] == "ml, numpy")
    return [{**row, "x numpy ml": row["Mpoints/s"] / reference} for row in rows]


def main() -> None:
    """Print the table."""
    for row in run():
        print(
            f"{row['fit']:32s} {row['Mpoints/s']:8.2f} Mpoints/s  {row['x numpy ml']:6.1f} x numpy ml"
            f"  peak memory {row['peak/input']:5.2f} x input"
        )


if __name__ == "__main__":
    main()
