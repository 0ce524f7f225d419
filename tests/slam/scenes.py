"""A room of known planes, a robot that drives through it, and what it would see: measurements with their covariance."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from shapely import box

from factors.association.observations import Observation, PlaneObservation
from slam import Keyframe, PlaneSlam
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.sensors.log import CloudScan, Event, LaserScan, OdometryReading
from slam.sensors.rig import Rig
from slam.sensors.wheel_noise import OdometryNoise
from spplanes import Location, Plane

NOISE = OdometryNoise()
_OF_CALIBRATION = {"scale_sigma", "curvature_sigma_rad_per_m"}
#: Wheels that hardly err, and are calibrated.
SURE_WHEELS = OdometryNoise(**dict.fromkeys(OdometryNoise.model_fields.keys() - _OF_CALIBRATION, 1e-6))
PERIOD_NS = 1_000_000_000
#: Heading, x and y of a Pose3 tangent.
IN_PLANE = [2, 3, 4]
#: (z m, theta rad, psi rad) of a measured plane.
SIGMAS = np.array([0.004, 0.003, 0.005])


def with_sensors(rig: Rig, **update: object) -> Rig:
    """A rig of which every sensor is described otherwise."""
    sensors = {name: sensor.model_copy(update=update) for name, sensor in rig.sensors.items()}
    return rig.model_copy(update={"sensors": sensors})


def room_planes() -> list[Plane]:
    """Four walls, floor and ceiling of a room of 8 x 6 x 3 m, normals inward."""

    def plane(x_axis: list[float], normal: list[float], centre: list[float], size: tuple[float, float]) -> Plane:
        frame = np.eye(4)
        frame[:3, :3] = np.column_stack((x_axis, np.cross(normal, x_axis), normal))
        frame[:3, 3] = centre
        half = np.array(size) / 2.0
        return Plane(frame, np.zeros((3, 3)), 500, box(-half[0], -half[1], half[0], half[1]))

    return [
        plane([1, 0, 0], [0, 0, 1], [0, 0, 0], (8.0, 6.0)),
        plane([1, 0, 0], [0, 0, -1], [0, 0, 3], (8.0, 6.0)),
        plane([0, 1, 0], [1, 0, 0], [-4, 0, 1.5], (6.0, 3.0)),
        plane([0, 1, 0], [-1, 0, 0], [4, 0, 1.5], (6.0, 3.0)),
        plane([1, 0, 0], [0, 1, 0], [0, -3, 1.5], (8.0, 3.0)),
        plane([1, 0, 0], [0, -1, 0], [0, 3, 1.5], (8.0, 3.0)),
    ]


@dataclass(frozen=True)
class Drive:
    """Keyframes of a drive, and the truth."""

    keyframes: list[Keyframe]
    world_T_body: np.ndarray


def measured(plane: Plane, rng: np.random.Generator, sigmas: np.ndarray = SIGMAS) -> Plane:
    """A plane drawn from its own covariance: the SP perturbation composed on the right."""
    drawn = Location.plane(plane.frame, np.diag(sigmas**2)).perturbed(sigmas * rng.standard_normal(3))
    return Plane(drawn.transform, drawn.covariance, plane.n_points, plane.outline)


def drive(seed: int, *, count: int = 15, turns: float = 0.75) -> Drive:
    """A drive round the room with odometry and planes drawn from their noise models."""
    rng, angle = np.random.default_rng(seed), np.linspace(0.0, 2.0 * np.pi * turns, count)
    way = np.column_stack((1.5 * np.cos(angle), 1.5 * np.sin(angle), angle + np.pi / 2.0))
    poses, keyframes = np.array([planar_transform(*pose) for pose in way]), []
    for index, pose in enumerate(poses):
        motion = None
        if index:
            delta = planar_delta(inverse(poses[index - 1]) @ pose)
            covariance = NOISE.covariance(delta)
            noisy = delta + np.linalg.cholesky(covariance) @ rng.standard_normal(3)
            motion = Motion(planar_transform(*noisy), covariance, (1e-3, 1e-3, 1e-3))
        planes = [measured(plane.transform(inverse(pose)), rng) for plane in room_planes()]
        seen: list[Observation] = [PlaneObservation(plane) for plane in planes]
        keyframes.append(Keyframe(index * PERIOD_NS, seen, motion, pose if index == 0 else None))
    return Drive(keyframes, poses)


def overstated(keyframes: Iterable[Keyframe], by: float) -> list[Keyframe]:
    """Keyframes that state covariances of their planes so many times too small."""
    found = []
    for frame in keyframes:
        planes = [one.plane for one in frame.observations if isinstance(one, PlaneObservation)]
        sure = [PlaneObservation(replace(plane, covariance=plane.covariance / by)) for plane in planes]
        found.append(replace(frame, observations=sure))
    return found


def run_of(keyframes: Iterable[Keyframe], slam: PlaneSlam | None = None) -> PlaneSlam:
    """An estimator, a plain one where none is given, that was handed them."""
    slam = PlaneSlam() if slam is None else slam
    for keyframe in keyframes:
        slam.add_keyframe(keyframe)
    return slam


def planar_nees(covariance: np.ndarray, truth: np.ndarray, estimate: np.ndarray) -> float:
    """Of a pose by its covariance (6, 6), the normalised error squared of heading, x and y."""
    error = gtsam.Pose3.Logmap(gtsam.Pose3(inverse(truth) @ estimate))[IN_PLANE]
    return float(error @ np.linalg.solve(covariance[np.ix_(IN_PLANE, IN_PLANE)], error))


COMPARED = {OdometryReading: ["odom_T_body"], CloudScan: ["points"], LaserScan: ["ranges", "angles", "world_T_body"]}


def assert_same_events(some: Iterable[Event], others: Iterable[Event], atol: float = 0.0) -> None:
    """Of two logs, bit for bit; with a tolerance, poses and bearings as near as it and single precision have them."""
    exact, near = {"rtol": 0.0, "atol": 0.0}, {"rtol": 1e-7 if atol else 0.0, "atol": atol}
    for a, b in zip(some, others, strict=True):
        [(kind, names)] = [(kind, names) for kind, names in COMPARED.items() if isinstance(a, kind)]
        assert isinstance(b, kind) and (a.stamp_ns, getattr(a, "sensor", "")) == (b.stamp_ns, getattr(b, "sensor", ""))
        for one, other, name in ((getattr(a, name), getattr(b, name), name) for name in names):
            assert (one is None) == (other is None)
            if one is not None:
                np.testing.assert_allclose(one, other, **(exact if name in ("ranges", "points") else near))
