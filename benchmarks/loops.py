"""Loops in simulated floor plans with truth: does the drive end where it should, and is any wall taken for another?

Run as ``python -m benchmarks.loops [seeds]``: corridors round a block with many, few and no doors, a long block with
361 beams to 30 m, and offices with clutter driven twice. The wheels read ways and turns wrongly, and slip.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

import numpy as np

from benchmarks.corpus.floorplan import Drive, LaserSettings, Wheels, drive, office, ring, wrong_landmarks
from slam import PlaneSlam, SlamConfig
from slam.frontend.keyframes import keyframes_of
from slam.geometry.frames import inverse
from slam.runs.slam_run import odometry_of
from slam.sensors.rig import default_rig_for

KINDS = ("many doors", "few doors", "no doors", "long block", "office")


def simulate(kind: str, seed: int) -> Drive:
    """A drive of one kind; walls, noise, wheels and slips come from the seed."""
    rng = np.random.default_rng(seed)
    wheels = Wheels(scale=rng.normal(0.0, 0.03), curvature_rad_per_m=rng.normal(0.0, 0.03))
    laser = LaserSettings()
    if kind == "long block":
        laser = LaserSettings(n_beams=361, range_max_m=30.0)
        plan = ring(rng, length_m=30.0, depth_m=10.0, doors_per_wall=5)
    elif kind == "office":
        laser, plan = LaserSettings(n_beams=180, range_max_m=30.0), office(rng)
    else:
        plan = ring(rng, doors_per_wall={"many doors": 4, "few doors": 2, "no doors": 0}[kind])
    return drive(plan, rng, laser, wheels)


def row_of(kind: str, seed: int, config: SlamConfig | None = None) -> dict[str, object]:
    """One run: errors against truth with the first pose given, m; landmarks made of two walls; NIS; time."""
    truth, config = simulate(kind, seed), config or SlamConfig()
    rig, slam = default_rig_for(truth.log), PlaneSlam(config)
    start = time.process_time()
    for keyframe in keyframes_of(truth.log, rig, config):
        slam.add_keyframe(keyframe)
    seconds = time.process_time() - start
    estimate = slam.trajectory
    errors, raw = (
        np.linalg.norm((inverse(path.poses[0]) @ path.poses - truth.poses_at(path.stamps_ns))[:, :2, 3], axis=1)
        for path in (estimate, odometry_of(truth.log, rig, estimate))
    )
    return {
        "plan": kind,
        "seed": seed,
        "odometry end m": round(float(raw[-1]), 2),
        "end m": round(float(errors[-1]), 3),
        "rmse m": round(float(np.sqrt(np.mean(errors**2))), 3),
        "max m": round(float(errors.max()), 3),
        "landmarks": len(slam.landmarks),
        "of two walls": len(wrong_landmarks(slam, truth)),
        "closed": sum(one.verdict == "closed" for one in slam.loops),
        "NIS": round(slam.audit.mean_per_dof, 2),
        "s": round(seconds, 1),
    }


def run(kinds: Sequence[str] = KINDS, seeds: Sequence[int] = (0, 1)) -> list[dict[str, object]]:
    """One row a plan and seed."""
    return [row_of(kind, seed) for kind in kinds for seed in seeds]


def main() -> None:
    """Print the table."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 2
    for kind in KINDS:
        for seed in range(count):
            print("  ".join(f"{name} {value}" for name, value in row_of(kind, seed).items()), flush=True)


if __name__ == "__main__":
    main()
