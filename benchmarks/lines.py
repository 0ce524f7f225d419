"""Speed of line extraction beside a textbook split (no covariance, no merge, no statistics), in one run.

Run as ``python -m benchmarks.lines``. One thread; medians of repeats, kernels warmed up. The scans are a simulated
room with boxes and pillars and a corridor with doors, sigma 10 mm, and, where they are, the real logs.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba import njit

from slam.io.carmen import read_carmen
from slam.io.log import LaserScan
from spplanes import extract_lines

REPEATS = 15
SIGMA_M = 0.01
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
Scan = tuple[np.ndarray, np.ndarray]


def rectangle(x: float, y: float, width: float, height: float) -> list[tuple[float, float, float, float]]:
    """Sides of a rectangle with a corner at (x, y), as x0, y0, x1, y1."""
    a, b = x + width, y + height
    return [(x, y, a, y), (a, y, a, b), (a, b, x, b), (x, b, x, y)]


def room() -> np.ndarray:
    """Walls of a room with three boxes in it, shape (K, 4)."""
    return np.array(
        rectangle(-3, -2, 8, 5) + rectangle(2, 1, 0.8, 0.5) + rectangle(3, -1.5, 0.4, 1) + rectangle(-2, 1, 1, 1)
    )


def corridor() -> np.ndarray:
    """Walls of a corridor with a recessed door every 3 m on both sides, shape (K, 4)."""
    walls = [(25.0, -1.2, 25.0, 1.2)]
    for x in np.arange(-6.0, 25.0, 3.0):
        for y, deep in ((-1.0, -1.15), (1.0, 1.15)):
            walls += [(x, y, x + 2, y), (x + 2, y, x + 2, deep), (x + 2, deep, x + 3, deep), (x + 3, deep, x + 3, y)]
    return np.array(walls)


def cast(walls: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Ranges (B,) of a laser at the origin, with noise."""
    ray, start = np.stack((np.cos(angles), np.sin(angles))), walls[:, :2]
    along = walls[:, 2:] - start
    cross = np.outer(ray[0], along[:, 1]) - np.outer(ray[1], along[:, 0])
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
        share = (np.outer(ray[1], start[:, 0]) - np.outer(ray[0], start[:, 1])) / cross
    reach[~((reach > 0) & (share >= 0) & (share <= 1))] = np.inf
    return reach.min(axis=1) + np.random.default_rng(0).normal(0.0, SIGMA_M, angles.size)


@njit(cache=True)
def textbook_split(points: np.ndarray, threshold: float) -> np.ndarray:
    """Starts of the pieces of the iterative end-point split: cut where a point is farthest from the chord."""
    n = len(points)
    starts = np.zeros(n + 1, dtype=np.bool_)
    stack = [(0, n - 1)]
    while len(stack) > 0:
        a, b = stack.pop()
        starts[a] = True
        chord = points[b] - points[a]
        length = np.hypot(chord[0], chord[1]) + 1e-12
        worst, at = threshold, -1
        for k in range(a + 1, b):
            offset = points[k] - points[a]
            distance = abs(chord[0] * offset[1] - chord[1] * offset[0]) / length
            if distance > worst:
                worst, at = distance, k
        if at > 0:
            stack.append((a, at))
            stack.append((at, b))
    return np.nonzero(starts)[0]


def textbook(ranges: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Points of the returns, split at three sigma."""
    seen = np.isfinite(ranges)
    points = np.stack((ranges[seen] * np.cos(angles[seen]), ranges[seen] * np.sin(angles[seen])), axis=1)
    return textbook_split(points, 3.0 * SIGMA_M)


def median_ms(call: Callable[[], object], inner: int = 20) -> float:
    """Median processor time of a call, ms, over REPEATS loops of `inner` calls."""
    call()
    times = []
    for _ in range(REPEATS):
        start = time.thread_time()
        for _ in range(inner):
            call()
        times.append((time.thread_time() - start) / inner)
    return 1e3 * float(np.median(times))


def simulated_scans() -> dict[str, Scan]:
    """The scans that are always there, by name."""
    half, full = np.radians(np.arange(-90, 90.01, 0.5)), np.radians(np.arange(-180, 180, 1.0))
    wide = np.radians(np.arange(-135, 135.01, 0.25))
    lasers = {"180 deg": half, "360 deg": full, "270 deg": wide}
    worlds = {"room": room(), "corridor": corridor()}
    return {f"{w}, {a}": (cast(walls, angles), angles) for w, walls in worlds.items() for a, angles in lasers.items()}


def row(name: str, scans: list[Scan]) -> dict:
    """One line of the table: the mean over the scans."""
    ours = median_ms(lambda: [extract_lines(*scan, sigma=SIGMA_M) for scan in scans], max(1, 20 // len(scans))) / len(
        scans
    )
    split = median_ms(lambda: [textbook(*scan) for scan in scans], max(1, 20 // len(scans))) / len(scans)
    lines = np.mean([len(extract_lines(*scan, sigma=SIGMA_M)) for scan in scans])
    return {
        "scan": name,
        "beams": scans[0][0].size,
        "lines": round(float(lines), 1),
        "ms": round(ours, 3),
        "kHz": round(1.0 / ours, 1),
        "textbook split ms": round(split, 3),
        "ratio": round(ours / split, 1),
    }


def run() -> list[dict]:
    """Rows of the table."""
    rows = [row(name, [scan]) for name, scan in simulated_scans().items()]
    for log in ("intel", "loop5"):
        path = DATA / log / f"{log}.clf.gz"
        if path.exists():
            scans = [scan for scan in read_carmen(path).scans() if isinstance(scan, LaserScan)][::10]
            rows.append(row(f"{log}, every 10th scan", [(scan.ranges, scan.angles) for scan in scans]))
    return rows


def main() -> None:
    """Print the table."""
    rows = run()
    widths = [max(len(key), *(len(str(r[key])) for r in rows)) for key in rows[0]]
    for cells in [list(rows[0]), *([str(value) for value in r.values()] for r in rows)]:
        print("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)))


if __name__ == "__main__":
    main()
