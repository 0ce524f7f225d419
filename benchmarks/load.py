"""A day of a 10 Hz mission at full speed: time and memory per keyframe from the first to the last.

`python -m benchmarks.load [HOURS]`; 24 hours are 864,000 scans and many hours of computing, so 0.5 by default.
The robot drives laps round a ring of corridors; scans are made one at a time, and measurements stay on the disk.
Each tenth is printed when it is reached, so that a run that is ended keeps what it has measured.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from slam import PlaneSlam
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import LineObservation
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.sensors.wheel_noise import OdometryNoise
from spplanes import extract_lines

PERIOD_NS, SPEED_M_PER_S, KEYFRAME_M = 100_000_000, 0.5, 0.5
SIGMA_M = 0.01
ANGLES = np.deg2rad(np.arange(-180.0, 180.0))
#: Outer and inner walls of the ring, and the rounded rectangle driven between them: half sizes, m.
OUTER, INNER, DRIVEN, RADIUS = (12.0, 8.0), (9.0, 5.0), (10.5, 6.5), 1.0
BODY_T_SENSOR = np.eye(4)


def run(hours: float = 0.5, *, slices: int = 10, seed: int = 0) -> list[dict]:
    """One row a tenth of the mission."""
    return list(rows_of(hours, slices=slices, seed=seed))


def rows_of(hours: float, *, slices: int = 10, seed: int = 0) -> Iterator[dict]:
    """The same, each as it is reached."""
    scans = round(hours * 3600e9 / PERIOD_NS)
    with tempfile.TemporaryDirectory(prefix="spplanes-load-") as folder:
        path = Path(folder) / "session.db"
        with PlaneSlam.open(path, forget_raw=True) as slam:
            taken: list[float] = []
            reached = 1
            for scan, keyframe in _keyframes(scans, np.random.default_rng(seed)):
                start = time.process_time()
                slam.add_keyframe(keyframe)
                taken.append(time.process_time() - start)
                if reached < slices and scan >= reached * scans / slices:
                    yield _row(scan, slam, taken, path)
                    reached += 1
                    taken.clear()
            yield _row(scans, slam, taken or [0.0], path)


def _row(scan: int, slam: PlaneSlam, taken: list[float], path: Path) -> dict:
    return {
        "scans": scan,
        "keyframes": len(slam.keyframes),
        "landmarks": len(slam.landmarks),
        "CPU ms per keyframe, median": 1e3 * float(np.median(taken)),
        "worst": 1e3 * max(taken),
        "memory, MB": _memory_mb(),
        "session, MB": sum(one.stat().st_size for one in path.parent.glob("session.db*")) / 1e6,
    }


def _memory_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


@dataclass
class _Drive:
    """What the wheels have said since the last keyframe."""

    noise: OdometryNoise
    rng: np.random.Generator
    steps: list[np.ndarray] = field(default_factory=list)

    def step(self, delta: np.ndarray) -> None:
        """One reading of the wheels, with their noise."""
        covariance = self.noise.random_covariances(delta[None])[0] + 1e-14 * np.eye(3)
        self.steps.append(delta + np.linalg.cholesky(covariance) @ self.rng.standard_normal(3))

    def motion(self) -> Motion:
        """All of them as one motion; starts anew."""
        total, covariance = self.noise.accumulate(np.array(self.steps))
        sigmas = (self.noise.z_sigma_m, self.noise.roll_sigma_rad, self.noise.pitch_sigma_rad)
        self.steps.clear()
        return Motion(planar_transform(*total.tolist()), covariance, sigmas)


def _keyframes(scans: int, rng: np.random.Generator) -> Iterator[tuple[int, Keyframe]]:
    drive = _Drive(OdometryNoise(), rng)
    walls, last, driven = _walls(), pose_at(0.0), 0.0
    for scan in range(scans):
        way = scan * PERIOD_NS * 1e-9 * SPEED_M_PER_S
        pose = pose_at(way)
        if scan:
            drive.step(planar_delta(inverse(last) @ pose))
        last = pose
        ranges = _ranges(pose, walls) + SIGMA_M * rng.standard_normal(len(ANGLES))
        if scan and way - driven < KEYFRAME_M:
            continue
        driven = way
        lines = extract_lines(ranges, ANGLES, sigma=SIGMA_M)
        seen = [LineObservation(line, BODY_T_SENSOR) for line in lines]
        yield scan, Keyframe(scan * PERIOD_NS, seen, drive.motion() if scan else None, None if scan else pose)


def pose_at(way: float) -> np.ndarray:
    """World pose (4, 4) after so much of the way round the ring, which has no end."""
    sides = [2.0 * (DRIVEN[0] - RADIUS), 2.0 * (DRIVEN[1] - RADIUS)] * 2
    turn = 0.5 * np.pi * RADIUS
    rest = way % (sum(sides) + 4.0 * turn)
    pose = planar_transform(-DRIVEN[0] + RADIUS, -DRIVEN[1], 0.0)
    for side in sides:
        pose = pose @ planar_transform(min(rest, side), 0.0, 0.0)
        rest -= side
        if rest <= 0.0:
            return pose
        angle = min(rest / RADIUS, 0.5 * np.pi)
        pose = pose @ planar_transform(RADIUS * np.sin(angle), RADIUS * (1.0 - np.cos(angle)), angle)
        rest -= turn
        if rest <= 0.0:
            return pose
    return pose


def _walls() -> np.ndarray:
    """Ends of the walls, shape (8, 2, 2), m."""
    walls = []
    for x, y in (OUTER, INNER):
        corners = np.array([(-x, -y), (x, -y), (x, y), (-x, y)])
        walls += [(corners[i], corners[(i + 1) % 4]) for i in range(4)]
    return np.array(walls)


def _ranges(pose: np.ndarray, walls: np.ndarray) -> np.ndarray:
    """True range of every beam, shape (B,), m."""
    heading = np.arctan2(pose[1, 0], pose[0, 0]) + ANGLES
    beams = np.column_stack((np.cos(heading), np.sin(heading)))
    starts, ways = walls[:, 0] - pose[:2, 3], walls[:, 1] - walls[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        area = beams[:, None, 0] * ways[None, :, 1] - beams[:, None, 1] * ways[None, :, 0]
        reach = (starts[None, :, 0] * ways[None, :, 1] - starts[None, :, 1] * ways[None, :, 0]) / area
        along = (starts[None, :, 0] * beams[:, None, 1] - starts[None, :, 1] * beams[:, None, 0]) / area
    hit = (reach > 0.0) & (along >= 0.0) & (along <= 1.0)
    return np.where(hit, reach, np.inf).min(axis=1)


def main() -> None:
    """Print each row when it is reached."""
    start = time.perf_counter()
    rows: list[dict] = []
    for row in rows_of(*(float(word) for word in sys.argv[1:2] or ["0.5"])):
        if not rows:
            print(" | ".join(row))
        print(
            " | ".join(f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()), flush=True
        )
        rows.append(row)
    if len(rows) < 2:
        return
    first, last = rows[0], rows[-1]
    grown = (last["memory, MB"] - first["memory, MB"]) * 1e3 / (last["keyframes"] - first["keyframes"])
    slower = last["CPU ms per keyframe, median"] / first["CPU ms per keyframe, median"]
    print(
        f"last tenth against the first: {slower:.2f} x; {grown:.1f} kB a keyframe; {time.perf_counter() - start:.0f} s"
    )


if __name__ == "__main__":
    main()
