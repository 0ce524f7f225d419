"""How time and memory grow with the mission: lap after lap of an office, keyframes drawn from its true planes.

Run as `python -m benchmarks growth`; 10,000 keyframes, 64 laps, take ten minutes or more of processor time.

Every keyframe sees a dozen planes near the robot, drawn from their own covariance, and drives half a metre on by an
odometry that drifts; nothing is measured from points, so the time is that of the estimator alone.
"""

import time
from collections.abc import Iterator
from itertools import islice

import numpy as np
from shapely import Polygon, box
from shapely.affinity import translate

from benchmarks._memory import resident_mb
from factors.association.observations import PlaneObservation
from slam import PlaneSlam, SlamConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.sensors.wheel_noise import OdometryNoise
from slam.simulation.buildings import loop_path, office
from spplanes import Location, Plane

#: Way between two keyframes, how far and how much of a plane is seen, m; how many planes at most.
STEP_M, REACH_M, PATCH_M, MOST = 0.5, 5.0, 2.5, 12
#: Standard deviation of (z m, theta rad, psi rad) of a measured plane.
SIGMAS = np.array([0.003, 0.004, 0.004])


def run(keyframes: int = 2000, seed: int = 0) -> list[dict]:
    """One row for every tenth of a mission."""
    slam, spent, rows, drive = PlaneSlam(SlamConfig()), _Spent(), [], mission(keyframes, seed)
    for part in np.array_split(np.arange(keyframes), 10):
        true = []
        for frame, pose in islice(drive, len(part)):
            spent.add(slam, frame)
            true.append(pose[:2, 3])
        away, row = slam.trajectory.poses[part[0] :, :2, 3] - np.array(true), spent.row(slam)
        row |= {
            "of the first tenth": row["median, ms"] / (rows[0] if rows else row)["median, ms"],
            "position, cm rms": 100.0 * float(np.sqrt((away**2).sum(axis=1).mean())),
        }
        rows.append({"keyframes": f"{part[0]} to {part[-1]} of {keyframes}", **row})
    return rows


class _Spent:
    """Time and memory since the last row, loop closures apart."""

    def __init__(self) -> None:
        self._seconds, self._closings, self._memory = [], [], resident_mb()

    def add(self, slam: PlaneSlam, frame: Keyframe) -> None:
        loops = sum(merge.cause == "loop" for merge in slam.merges.history)
        start = time.process_time()
        slam.add_keyframe(frame)
        taken = time.process_time() - start
        closed = sum(merge.cause == "loop" for merge in slam.merges.history) > loops
        (self._closings if closed else self._seconds).append(taken)

    def row(self, slam: PlaneSlam) -> dict[str, float]:
        """What was spent, and starts anew."""
        memory, count = resident_mb(), len(self._seconds) + len(self._closings)
        stages = {name: slam.backend.clock.seconds.get(name, 0.0) for name in ("optimise", "marginals")}
        outer = sum(slam.clock.seconds.values())
        row: dict[str, float] = {
            "median, ms": 1e3 * float(np.median(self._seconds)),
            "90 %, ms": 1e3 * float(np.percentile(self._seconds, 90)),
            **{f"{name}, %": 100.0 * seconds / outer for name, seconds in stages.items()},
            "closures": len(self._closings),
            "longest, ms": 1e3 * max(self._closings, default=0.0),
            "poses held": len(slam.keyframes) - slam.backend.n_left,
            "landmarks": len(slam.landmarks),
            "peak memory MB": memory,
            "kB per keyframe": 1e3 * (memory - self._memory) / count,
        }
        slam.clock.seconds.clear()
        slam.backend.clock.seconds.clear()
        self._seconds, self._closings, self._memory = [], [], memory
        return row


def mission(count: int, seed: int) -> Iterator[tuple[Keyframe, np.ndarray]]:
    """Keyframes of a robot that drives round the office as often as it takes, with their true poses."""
    rng, laps = np.random.default_rng(seed), int(np.ceil(count * STEP_M / 78.0)) + 1
    path, planes, noise, before = loop_path("office", laps), office().planes, OdometryNoise(), None
    for index in range(count):
        pose, motion = planar_transform(*path.at(np.array([index * STEP_M]))[0]), None
        if before is not None:
            delta = planar_delta(inverse(before) @ pose)
            covariance = noise.covariance(delta)
            drawn = delta + np.linalg.cholesky(covariance) @ rng.standard_normal(3)
            motion = Motion(planar_transform(*drawn), covariance, (1e-3, 1e-3, 1e-3))
        yield Keyframe(index * 10**9, seen_from(pose, planes, rng), motion, pose if index == 0 else None), pose
        before = pose


def seen_from(world_T_body: np.ndarray, planes: list[Plane], rng: np.random.Generator) -> list[PlaneObservation]:
    """The planes about the robot, those of which most is seen first."""
    eye, found = world_T_body[:3, 3] + np.array([0.0, 0.0, 0.5]), []
    for plane in planes:
        if not 0.0 < float(plane.distance(eye)) < REACH_M or plane.outline is None:
            continue
        u, v = ((eye - plane.centre) @ plane.frame[:3, :2]).tolist()
        patch = plane.outline.intersection(box(u - PATCH_M, v - PATCH_M, u + PATCH_M, v + PATCH_M))
        if isinstance(patch, Polygon) and patch.area > 0.5:
            found.append((patch.area, plane, patch))
    largest = sorted(found, key=lambda one: -one[0])[:MOST]
    return [PlaneObservation(_measured(plane, patch, inverse(world_T_body), rng)) for _, plane, patch in largest]


def _measured(plane: Plane, patch: Polygon, body_T_world: np.ndarray, rng: np.random.Generator) -> Plane:
    """The patch in the body frame, moved by an error drawn from its covariance, composed on the right."""
    x, y, middle = patch.centroid.x, patch.centroid.y, np.eye(4)
    middle[:2, 3] = x, y
    seen = Location.plane(body_T_world @ plane.frame @ middle, np.diag(SIGMAS**2))
    frame = seen.perturbed(SIGMAS * rng.standard_normal(3)).transform
    return Plane(frame, seen.covariance, 1000, translate(patch, -x, -y))
