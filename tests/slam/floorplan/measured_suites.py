"""Simulated office suites with truth, mapped: are widths, areas, heights and openings as sure as they say?"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.corpus.suite import START_M, Suite
from factors.association.observations import PlaneObservation
from slam.config import SlamConfig
from slam.floorplan import FloorPlan, JointPlanes, Quantity, floor_plan, joint_planes
from slam.frontend.keyframes import Keyframe, keyframes_of
from slam.geometry.frames import inverse, settle_frame
from slam.planeslam import PlaneSlam
from slam.sensors.rig import Rig
from slam.simulation.record import Plan, Truth, record
from slam.simulation.robots import spinning_rig
from spplanes import Plane
from spplanes._check import FloatArray
from tests.slam.scenes import run_of, with_sensors

#: An observation is of a true plane within this distance of its centre and cosine of the angle to it, m.
_NEAR_M, _ALIKE = 0.05, np.cos(0.05)
#: Eigenvalues of a joint covariance below this share of the largest are of differences that are zero by construction:
#: every room of a suite has the same floor and ceiling.
_NOTHING = 1e-6

Pairs = list[tuple[Quantity, float]]


@dataclass(frozen=True, eq=False)
class Measured:
    """A suite, and what a robot with a spinning laser measured in it."""

    suite: Suite
    rig: Rig
    keyframes: list[Keyframe]
    truth: Truth
    seed: int

    @classmethod
    def of(cls, seed: int, *, range_sigma_m: float = 0.005, spacing_m: float = 0.6, rooms_a_side: int = 2) -> Measured:
        """Drive through a suite of one's own."""
        suite = Suite.drawn(np.random.default_rng(seed), rooms_a_side=rooms_a_side)
        rig = with_sensors(spinning_rig(), range_sigma_m=range_sigma_m)
        plan = Plan("suite", suite.world(), suite.path(), rig, spacing_m)
        log, truth = record(plan, int(plan.path.length_m / spacing_m) + 1, seed)
        return cls(suite, rig, list(keyframes_of(log, rig, SlamConfig())), truth, seed)

    def drawn(self) -> list[Keyframe]:
        """The same with every plane drawn about its true one; what is near none is left out."""
        rng, frames = np.random.default_rng((self.seed, 1)), []
        for frame in self.keyframes:
            body_T_world = inverse(self.truth.poses_at(np.array([frame.stamp_ns]))[0])
            true = [plane.transform(body_T_world) for plane in self.truth.planes]
            planes = [one for one in frame.observations if isinstance(one, PlaneObservation)]
            drawn = [_drawn(one, true, rng) for one in planes]
            frames.append(replace(frame, observations=[one for one in drawn if one is not None]))
        return frames


def _drawn(seen: PlaneObservation, true: Sequence[Plane], rng: np.random.Generator) -> PlaneObservation | None:
    """The observation on the true plane that it lies on, moved by an error of its own covariance."""
    frame = seen.plane.frame
    alike = [one for one in true if one.normal @ frame[:3, 2] > _ALIKE]
    nearest = min(alike, key=lambda one: abs(float(one.distance(frame[:3, 3]))), default=None)
    if nearest is None or abs(float(nearest.distance(frame[:3, 3]))) > _NEAR_M:
        return None
    on_it = settle_frame(frame, nearest.normal, nearest.d)
    shift, theta, psi = rng.multivariate_normal(np.zeros(3), seen.plane.covariance)
    normal = on_it[:3, :3] @ np.array([theta, -psi, 1.0])  # z = shift - theta x + psi y
    normal /= np.linalg.norm(normal)
    moved = settle_frame(on_it, normal, float(normal @ (on_it[:3, 3] + shift * on_it[:3, 2])))
    return replace(seen, plane=Plane(moved, seen.plane.covariance, seen.plane.n_points, seen.plane.outline))


def mapped(keyframes: Iterable[Keyframe]) -> PlaneSlam:
    """An estimator that was given them, solved as a whole at the end, as the export of a plan does."""
    slam = run_of(keyframes)
    slam.adopt_batch()
    return slam


def plan_of(slam: PlaneSlam) -> FloorPlan:
    """The floor plan of a map."""
    return floor_plan(joint_planes(slam.planes, slam.landmarks, slam.backend))


def pairs_of(suite: Suite, plan: FloorPlan) -> dict[str, Pairs]:
    """Everything measured beside its truth, by kind; rooms are told by where their middle is."""
    (storey,) = plan.storeys
    found: dict[str, Pairs] = defaultdict(list)
    for room in storey.rooms:
        true = suite.room_at(room.middle[0] + START_M, room.middle[1])
        found["area"].append((room.area, true.area_m2))
        found["width"] += [(w.distance, _along(w.second - w.first, true.width_m, true.depth_m)) for w in room.widths]
        if room.height is not None:
            found["height"].append((room.height, suite.height_m))
    for wall in storey.walls:
        found["thickness"].append((wall.thickness, _along(wall.front.normal, suite.partition_m, suite.wall_m)))
    for opening in storey.openings:
        if opening.width is not None:
            x, y, _ = opening.outline.mean(axis=0)
            found["opening"].append((opening.width, suite.door_at(x + START_M, y).width_m))
    return found


def _along(direction: FloatArray, along_x: float, along_y: float) -> float:
    return along_x if abs(direction[0]) > abs(direction[1]) else along_y


def nees_of(joint: JointPlanes, pairs: Pairs) -> tuple[float, int]:
    """Squared error of several quantities under their joint covariance, and its degrees of freedom."""
    if not pairs:
        return 0.0, 0
    errors = np.array([quantity.value - true for quantity, true in pairs])
    variances, vectors = np.linalg.eigh(joint.covariance_of([quantity for quantity, _ in pairs]))
    real = variances > _NOTHING * variances[-1]
    return float(((vectors.T @ errors)[real] ** 2 / variances[real]).sum()), int(real.sum())
