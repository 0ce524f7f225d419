"""How time and memory grow with the mission: lap after lap of an office, keyframes drawn from its true planes.

`python -m benchmarks.growth [KEYFRAMES]`

Every keyframe sees a dozen planes near the robot, drawn from their own covariance, and drives half a metre on by an
odometry that drifts; nothing is measured from points, so the time is that of the estimator alone.
"""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.table import Table
from shapely import Polygon, box

from slam import PlaneSlam
from slam.frames import inverse
from slam.io.log import planar_transform
from slam.keyframes import Keyframe
from slam.motion import OdometryNoise
from slam.observations import PlaneObservation
from slam.odometry import Motion, planar_delta
from slam.simulation.office import office, office_path
from spplanes import Plane

#: Way between two keyframes, how far and how much of a plane is seen, m; how many planes at most.
STEP_M, REACH_M, PATCH_M, MOST = 0.5, 5.0, 2.5, 12
#: Standard deviation of (z m, theta rad, psi rad) of a measured plane.
SIGMAS = np.array([0.003, 0.004, 0.004])


def run(keyframes: int = 2000, seed: int = 0) -> list[dict]:
    """One row for every tenth of a mission."""
    slam, seconds, closing = PlaneSlam(), [], []
    memory = _resident_mb()
    for frame in mission(keyframes, seed):
        loops, merges = len(slam.loops), len(slam.merges.history)
        start = time.process_time()
        slam.add_keyframe(frame)
        seconds.append(time.process_time() - start)
        closing.append(len(slam.merges.history) > merges and len(slam.loops) > loops)
    memory = _resident_mb() - memory
    tenths = np.array_split(np.arange(len(seconds)), 10)
    times, apart = 1e3 * np.array(seconds), np.array(closing)
    return [
        {
            "keyframes": f"{part[0]} to {part[-1]}",
            "median, ms": float(np.median(times[part][~apart[part]])),
            "90 %, ms": float(np.percentile(times[part][~apart[part]], 90)),
            "loop closures": int(apart[part].sum()),
            "of the first tenth": float(np.median(times[part][~apart[part]]) / np.median(times[tenths[0]])),
            "landmarks": len(slam.landmarks),
            "kB per keyframe": 1e3 * memory / len(seconds),
        }
        for part in tenths
    ]


def mission(count: int, seed: int) -> Iterator[Keyframe]:
    """Keyframes of a robot that drives round the office as often as it takes."""
    rng = np.random.default_rng(seed)
    laps = int(np.ceil(count * STEP_M / 78.0)) + 1
    path, planes, noise = office_path(laps), office().planes, OdometryNoise()
    before = None
    for index in range(count):
        pose = planar_transform(*path.at(np.array([index * STEP_M]))[0])
        motion = None
        if before is not None:
            delta = planar_delta(inverse(before) @ pose)
            covariance = noise.covariance(delta)
            drawn = delta + np.linalg.cholesky(covariance) @ rng.standard_normal(3)
            motion = Motion(planar_transform(*drawn), covariance, (1e-3, 1e-3, 1e-3))
        yield Keyframe(index * 10**9, seen_from(pose, planes, rng), motion, pose if index == 0 else None)
        before = pose


def seen_from(world_T_body: np.ndarray, planes: list[Plane], rng: np.random.Generator) -> list[PlaneObservation]:
    """The planes about the robot, those of which most is seen first."""
    eye = world_T_body[:3, 3] + np.array([0.0, 0.0, 0.5])
    found = []
    for plane in planes:
        height = float(plane.distance(eye))
        if not 0.0 < height < REACH_M or plane.outline is None:
            continue
        u, v = ((eye - plane.centre) @ plane.frame[:3, :2]).tolist()
        patch = plane.outline.intersection(box(u - PATCH_M, v - PATCH_M, u + PATCH_M, v + PATCH_M))
        if isinstance(patch, Polygon) and patch.area > 0.5:
            found.append((patch.area, plane, patch))
    largest = sorted(found, key=lambda one: -one[0])[:MOST]
    return [PlaneObservation(_measured(plane, patch, inverse(world_T_body), rng)) for _, plane, patch in largest]


def _measured(plane: Plane, patch: Polygon, body_T_world: np.ndarray, rng: np.random.Generator) -> Plane:
    """The patch in the body frame, moved by an error drawn from its covariance, composed on the right."""
    from shapely.affinity import translate

    x, y = patch.centroid.x, patch.centroid.y
    z, theta, psi = SIGMAS * rng.standard_normal(3)
    (cy, sy), (cx, sx) = ((np.cos(angle), np.sin(angle)) for angle in (theta, psi))
    error = np.eye(4)
    error[:3, :3] = np.array([[cy, 0.0, sy], [0.0, 1.0, 0.0], [-sy, 0.0, cy]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, cx, -sx], [0.0, sx, cx]]
    )
    middle = np.eye(4)
    middle[:3, 3] = x, y, 0.0
    error[2, 3] = z
    frame = body_T_world @ plane.frame @ middle @ error
    return Plane(frame, np.diag(SIGMAS**2), 1000, translate(patch, -x, -y))


def _resident_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    """Print the tenths of a mission."""
    rows = run(*[int(word) for word in sys.argv[1:2]])
    table = Table(title="time per keyframe over a mission, one core, CPU time")
    for name in rows[0]:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*(value if isinstance(value, str) else f"{value:.3g}" for value in row.values()))
    Console(width=160).print(table)


if __name__ == "__main__":
    main()
