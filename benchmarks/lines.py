"""Lines of laser scans beside a textbook split on the same scans: speed, what is found and what is false.

Run as ``python -m benchmarks lines``. One thread. Random rooms and corridors of `benchmarks._line_world` with truth, 10
and 30 mm of noise, and, where they are, the real logs. The textbook's split (iterative end points, three sigma) has no
covariance and no statistics; its pieces are judged as lines by their beams alone, and that judging is not timed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial

import numpy as np
from numba import njit

from benchmarks._line_score import Score
from benchmarks._line_world import Truth, World, cast, random_corridor, random_room
from benchmarks._measure import PROJECT, Case, Row, Task, measured
from spplanes import LineConfig, ScanLine, extract_lines

DATA = PROJECT.parent / "shared" / "data"
#: Bearings of lasers, by what they are called.
LASERS = {
    "361 beams, 180 deg": np.radians(np.arange(-90, 90.01, 0.5)),
    "360 beams, 360 deg": np.radians(np.arange(-180, 180, 1.0)),
    "1081 beams, 270 deg": np.radians(np.arange(-135, 135.01, 0.25)),
}
WORLDS = {"rooms": random_room, "corridors": random_corridor}
SCANS = 100
#: Of a piece nothing is known but its beams: a covariance with which any line through them passes.
ANY = np.diag([1e6, 1e6])
Extraction = Callable[[np.ndarray, np.ndarray, float], list[ScanLine]]


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan, and what it is of where that is known."""

    ranges: np.ndarray
    """Shape (B,), m; NaN = no return."""
    angles: np.ndarray
    """Shape (B,), rad."""
    sigma: float
    """Range noise, m."""
    truth: tuple[World, tuple[float, float, float], Truth] | None = None
    """World, pose in it, and the scan without noise."""


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


def textbook(ranges: np.ndarray, angles: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points of the returns, split at three sigma: beams, points, starts of the pieces."""
    beams = np.flatnonzero(np.isfinite(ranges))
    r, a = ranges[beams], angles[beams]
    points = np.stack((r * np.cos(a), r * np.sin(a)), axis=1)
    return beams, points, textbook_split(points, 3.0 * sigma) if len(points) else beams


def pieces_as_lines(beams: np.ndarray, points: np.ndarray, starts: np.ndarray) -> list[ScanLine]:
    """The pieces of as many beams as our lines need, with the line of least squares through each."""
    lines, least = [], LineConfig().min_points
    for a, b in zip(starts, [*starts[1:], len(beams)], strict=True):
        if b - a >= least:
            centre = points[a:b].mean(axis=0)
            normal = np.linalg.svd(points[a:b] - centre)[2][1]
            normal *= 1.0 if normal @ centre >= 0.0 else -1.0
            alpha, rho = float(np.arctan2(normal[1], normal[0])), float(normal @ centre)
            lines.append(ScanLine(alpha, rho, ANY, points[[a, b - 1]], beams[a:b]))
    return lines


@cache
def simulated(world: str, laser: str, sigma: float) -> list[Scan]:
    """Scans of random worlds, each with its truth."""
    rng, angles, scans = np.random.default_rng(11), LASERS[laser], []
    for _ in range(SCANS):
        place, pose = WORLDS[world](rng)
        truth = cast(place, angles, pose)
        scans.append(Scan(truth.ranges + rng.normal(0.0, sigma, angles.size), angles, sigma, (place, pose, truth)))
    return scans


@cache
def logged(log: str) -> list[Scan]:
    """Scans spread over a real log."""
    from slam.io.carmen import read_carmen
    from slam.sensors.log import LaserScan

    scans = [scan for scan in read_carmen(DATA / log / f"{log}.clf.gz").scans() if isinstance(scan, LaserScan)]
    return [Scan(scan.ranges, scan.angles, 0.01) for scan in scans[:: len(scans) // SCANS]][:SCANS]


def score(scans: list[Scan], found: list[list[ScanLine]], *, honest: bool = True) -> Row:
    """Lines a scan; with truth the detectable walls found, the false lines and, of honest covariances, their NEES."""
    row: Row = {"lines a scan": sum(map(len, found)) / len(scans)}
    total = Score()
    for scan, lines in zip(scans, found, strict=True):
        if scan.truth is None:
            return row
        world, pose, truth = scan.truth
        total.add_scan(world, pose, truth, lines, scan.angles, scan.sigma, LineConfig())
    return row | {
        "walls found": f"{total.found}/{total.detectable}",
        "false lines": total.false,
        "NEES (2)": float(np.mean(total.nees)) if honest else None,
    }


def contenders(scans: Callable[[], list[Scan]]) -> list[Task]:
    """Ours and the textbook's."""
    all_of_them = scans()

    def ours() -> list[list[ScanLine]]:
        return [extract_lines(scan.ranges, scan.angles, sigma=scan.sigma, shared_error=False) for scan in all_of_them]

    def theirs() -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        return [textbook(scan.ranges, scan.angles, scan.sigma) for scan in all_of_them]

    return [
        Task("spplanes", ours, partial(score, all_of_them), repeats=9, things=len(all_of_them)),
        Task(
            "textbook split",
            theirs,
            lambda found: score(all_of_them, [pieces_as_lines(*one) for one in found], honest=False),
            repeats=9,
            things=len(all_of_them),
        ),
    ]


CASES: dict[str, Case] = {}
for _sigma in (0.01, 0.03):
    for _world in WORLDS:
        for _laser in LASERS:
            _scans = partial(simulated, _world, _laser, _sigma)
            CASES[f"{_world}, {_laser}, {1e3 * _sigma:.0f} mm"] = partial(contenders, _scans)
for _log in ("intel", "loop5"):
    if (DATA / _log).is_dir():
        CASES[f"{_log}, {SCANS} scans"] = partial(contenders, partial(logged, _log))


def run(*, short: bool = False) -> list[Row]:
    """One row for each contender of each kind of scan."""
    return measured("benchmarks.lines", CASES, short=short)
