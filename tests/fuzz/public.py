"""Every public function that takes arrays, each fed with any floats: the first number chooses which."""

from collections.abc import Callable
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

import factors
from slam import Keyframe, PlaneSlam
from slam.frontend.odometry import Motion
from spplanes import (
    Location,
    Moments,
    Plane,
    PlaneMapper,
    ScanLine,
    extract_lines,
    fit_plane,
    fit_planes,
    segment_cloud,
    segment_scans,
)
from tests.fuzz.target import Target, check_planes, check_poses
from tests.slam.scenes import drive, room_planes


class Numbers:
    """Arrays out of the numbers of an input, one after another; zeros where these end."""

    def __init__(self, numbers: np.ndarray) -> None:
        self._numbers, self._place = numbers, 0

    def array(self, *shape: int) -> np.ndarray:
        size = int(np.prod(shape))
        found = self._numbers[self._place : self._place + size]
        self._place += size
        return np.concatenate((found, np.zeros(size - len(found)))).reshape(shape)

    def number(self) -> float:
        return float(self.array(1)[0])

    def moments(self, count: int) -> Moments:
        return Moments.from_points(self.array(count, 3), self.array(count))

    def plane(self) -> Plane:
        return Plane(self.array(4, 4), self.array(3, 3), 10)

    def line(self) -> ScanLine:
        return ScanLine(self.number(), self.number(), self.array(2, 2), self.array(2, 2), np.arange(3), 1.0)

    def covariances(self, count: int, size: int) -> np.ndarray:
        return np.stack([self.array(size, size) for _ in range(count)])

    def location(self) -> Location:
        return Location(self.array(4, 4), self.array(6, 6))

    def landmark(self) -> gtsam.OrientedPlane3:
        return factors.plane_landmark(self.plane())

    def plane_observation(self) -> factors.PlaneObservation:
        return factors.PlaneObservation(self.plane())

    def line_observation(self) -> factors.LineObservation:
        return factors.LineObservation(self.line(), self.array(4, 4))

    def prediction(self) -> factors.Prediction:
        """A pose (0), another that anchors a landmark (2), and a landmark in the world (3), with any covariance."""
        return factors.Prediction.of_matrix(self.array(18, 18), [0, 1, 2, 3], _values(), 0)

    def extents(self) -> factors.LandmarkExtents:
        """What pose 1 saw of both landmarks."""
        extents = factors.LandmarkExtents()
        extents.start(2, self.plane(), 1, _values(), anchor_key=1)
        extents.start(3, self.line_observation(), 1, _values())
        return extents


@cache
def _drive() -> list[Keyframe]:
    return drive(0, count=4).keyframes


def _mapped(n: Numbers) -> list[Plane]:
    """Planes of four scans of twelve beams, each with its covariance."""
    scans, covariance, mapper = n.array(4, 12, 3), n.array(3, 3), PlaneMapper()
    for points in scans:
        mapper.add_scan(points, np.repeat(covariance[None], 12, axis=0))
    return mapper.planes


def _driven(n: Numbers) -> list[np.ndarray]:
    """Poses of a drive of two keyframes, then one of any numbers, then one that is right again."""
    frame, covariance, step, moved, later_s = n.array(4, 4), n.array(3, 3), n.array(4, 4), n.array(3, 3), n.number()
    known, slam, problem = _drive(), PlaneSlam(), None
    for keyframe in known[:2]:
        slam.add_keyframe(keyframe)
    try:
        line = ScanLine(*step[0, :2].tolist(), covariance[:2, :2], frame[:2, :2], np.arange(3), 1.0)
        seen = [factors.PlaneObservation(Plane(frame, covariance, 10)), factors.LineObservation(line, frame)]
        stamp_ns = known[1].stamp_ns + int(1e9 * np.clip(np.nan_to_num(later_s), -1.0, 0.5))
        slam.add_keyframe(Keyframe(stamp_ns, seen, Motion(step, moved, (1e-3, 1e-3, 1e-3))))
    except ValueError as error:
        problem = error
        assert len(slam.keyframes) == 2, "a keyframe that was refused left a trace"
    slam.add_keyframe(known[2])
    check_poses(slam.trajectory.poses)
    if problem is not None:
        raise problem
    return []


Call = Callable[[Numbers], Any]

#: What is called of each public name, of some in two ways; `_check` knows what must hold of answers of each kind.
CALLS: dict[str, Call] = {
    "spplanes.Location": Numbers.location,
    "spplanes.Location.point": lambda n: Location.point(n.array(3), n.array(3, 3)),
    "spplanes.Location.plane": lambda n: Location.plane(n.array(4, 4), n.array(3, 3)),
    "spplanes.Location.line_2d": lambda n: Location.line_2d(n.number(), n.number(), n.number(), n.array(2, 2)),
    "spplanes.Location.robot_2d": lambda n: Location.robot_2d(n.number(), n.number(), n.number(), n.array(3, 3)),
    "spplanes.Location.pose": lambda n: Location.pose(n.array(4, 4), n.array(6, 6)),
    "spplanes.Location.perturbed": lambda n: n.location().perturbed(n.array(6)),
    "spplanes.Location.perturbation_to": lambda n: n.location().perturbation_to(n.array(4, 4)),
    "spplanes.Location.compose": lambda n: n.location().compose(n.location()),
    "spplanes.Location.inverse": lambda n: n.location().inverse(),
    "spplanes.Location.relative": lambda n: n.location().relative(n.location()),
    "spplanes.Moments.from_points": lambda n: n.moments(5).scatter,
    "spplanes.Moments.merge": lambda n: n.moments(3).merge(n.moments(3)).scatter,
    "spplanes.Moments.plane": lambda n: n.moments(5).plane(),
    "spplanes.fit_plane": lambda n: fit_plane(n.array(9, 3), sigma=n.number()),
    "spplanes.fit_plane, scans": lambda n: fit_plane(
        n.array(6, 3), n.covariances(6, 3), scan_index=np.arange(6) % 2, pose_covariances=n.covariances(2, 6)
    ),
    "spplanes.fit_planes": lambda n: fit_planes(
        n.array(6, 3), n.covariances(6, 3), np.zeros(6, dtype=np.int64), method="sp"
    ),
    "spplanes.extract_lines": lambda n: extract_lines(
        sigma=n.number(), ranges=n.array(90), angles=np.linspace(-np.pi, np.pi, 90, endpoint=False)
    ),
    "spplanes.segment_scans": lambda n: segment_scans(sigma=n.number(), points=n.array(12, 16, 3))[1],
    "spplanes.segment_cloud": lambda n: (
        segment_cloud(sigma=n.number(), cloud=n.array(192, 3), viewpoint=n.array(3)).planes
    ),
    "spplanes.PlaneMapper.add_scan": _mapped,
    "spplanes.Plane": Numbers.plane,
    "spplanes.Plane.transform": lambda n: n.plane().transform(n.array(4, 4), n.array(6, 6)),
    "spplanes.Plane.merge": lambda n: n.plane().merge(n.plane()),
    "spplanes.Plane.mahalanobis": lambda n: n.plane().mahalanobis(n.plane()),
    "spplanes.Plane.from_hesse": lambda n: Plane.from_hesse(n.array(3), n.number(), n.array(3, 3), centre=n.array(3)),
    "spplanes.Plane.distance": lambda n: n.plane().distance(n.array(4, 3)),
    "spplanes.Plane.project": lambda n: n.plane().project(n.array(4, 3)),
    "spplanes.ScanLine": Numbers.line,
    "spplanes.ScanLine.transform": lambda n: n.line().transform(n.array(4, 4), n.array(3, 3)),
    "spplanes.ScanLine.covariance_at": lambda n: n.line().covariance_at(n.number()),
    "spplanes.ScanLine.mahalanobis": lambda n: n.line().mahalanobis(n.line()),
    "factors.anchored_plane_jacobian": lambda n: factors.anchored_plane_jacobian(
        n.landmark(), n.array(4, 4), n.array(4, 4)
    ),
    "factors.change_anchor": lambda n: factors.change_anchor(n.landmark(), n.array(4, 4), n.array(4, 4)),
    "factors.direction_prior": lambda n: factors.direction_prior(2, n.array(3), n.number()),
    "factors.distance_factor": lambda n: factors.distance_factor(2, 3, n.number(), n.number(), at=n.array(3)),
    "factors.facing": lambda n: factors.facing(n.plane(), n.array(3)),
    "factors.get_ready": lambda n: factors.get_ready([n.plane(), n.plane()]),
    "factors.landmark_hesse": lambda n: factors.landmark_hesse(n.landmark())[0],
    "factors.landmark_to_plane": lambda n: factors.landmark_to_plane(n.landmark(), n.array(3, 3), centre=n.array(3)),
    "factors.line_factor_2d": lambda n: factors.line_factor_2d(n.line(), n.array(4, 4), 4, 2),
    "factors.map_prior": lambda n: factors.map_prior([n.plane(), n.plane()], [2, 3], n.array(6, 6)),
    "factors.constant_velocity_factor": lambda n: factors.constant_velocity_factor(
        [0, 1, 6], n.array(6, 6), kept=n.array(6)
    ),
    "factors.gravity_factor": lambda n: factors.gravity_factor(0, n.array(3), n.number()),
    "factors.odometry_factor_2d": lambda n: factors.odometry_factor_2d(4, 5, n.array(3), n.array(3, 3)),
    "factors.parallel_factor": lambda n: factors.parallel_factor(2, 3, n.number()),
    "factors.perpendicular_factor": lambda n: factors.perpendicular_factor(2, 3, n.number()),
    "factors.planar_motion_factor": lambda n: factors.planar_motion_factor(
        0, height=n.number(), sigmas=n.array(3).tolist()
    ),
    "factors.plane_factor": lambda n: factors.plane_factor(n.plane(), 0, 2),
    "factors.line_factor": lambda n: factors.line_factor(n.line(), n.array(4, 4), 0, 2),
    "factors.odometry_factor": lambda n: factors.odometry_factor(0, 1, n.array(3), n.array(3, 3)),
    "factors.plane_factors": lambda n: factors.plane_factors([n.plane()], [0], [2], [1]),
    "factors.plane_landmark": lambda n: factors.plane_landmark(n.plane(), n.array(4, 4)),
    "factors.plane_prior": lambda n: factors.plane_prior(n.plane(), 2),
    "factors.pose_prior": lambda n: factors.pose_prior(0, n.array(4, 4), n.array(6, 6)),
    "factors.relative_pose_factor": lambda n: factors.relative_pose_factor(0, 1, n.array(4, 4), n.array(6, 6)),
    "factors.upright_prior": lambda n: factors.upright_prior(2, n.number(), up=n.array(3)),
    "factors.world_plane_from_joint": lambda n: factors.world_plane_from_joint(
        n.landmark(), n.array(4, 4), n.array(9, 9), centre=n.array(3)
    ),
    "factors.AssociationGates": lambda n: factors.AssociationGates(*n.array(len(fields(factors.AssociationGates)))),
    "factors.LandmarkExtents.see": lambda n: n.extents().see(2, n.plane_observation(), 0, _values()),
    "factors.LandmarkExtents.start": Numbers.extents,
    "factors.LineObservation": Numbers.line_observation,
    "factors.LineObservation.factor": lambda n: n.line_observation().factor(0, 2, 1),
    "factors.LineObservation.full_plane": lambda n: n.line_observation().full_plane(n.number()),
    "factors.LineObservation.on_uneven_wall": lambda n: n.line_observation().on_uneven_wall(n.number(), n.number()),
    "factors.LineObservation.patch_in": lambda n: n.line_observation().patch_in(n.array(4, 4)),
    "factors.PlaneObservation": Numbers.plane_observation,
    "factors.PlaneObservation.factor": lambda n: n.plane_observation().factor(0, 2, 1),
    "factors.PlaneObservation.full_plane": lambda n: n.plane_observation().full_plane(n.number()),
    "factors.PlaneObservation.patch_in": lambda n: n.plane_observation().patch_in(n.array(4, 4)),
    "factors.Prediction.covariance": lambda n: n.prediction().covariance(0),
    "factors.Prediction.joint_covariance": lambda n: n.prediction().joint_covariance([3, 0]).full,
    "factors.Prediction.of_matrix": Numbers.prediction,
    "factors.associate": lambda n: factors.associate(
        [n.plane(), n.line_observation()], n.prediction(), n.extents(), least_probability=n.number()
    ),
    "slam.PlaneSlam.add_keyframe": _driven,
}
#: Those that take no array (settings, paths, what GTSAM made itself, or nothing), or are part of a call above.
WITHOUT_ARRAYS = {
    *("spplanes.Plane.to_dict", "spplanes.Plane.from_dict", "spplanes.PlaneMapper", "slam.PlaneSlam", "slam.Keyframe"),
    *("spplanes.__version__", "spplanes.LineConfig", "spplanes.MapperConfig", "spplanes.MapperConfig.for_rows"),
    *("spplanes.Moments", "spplanes.Moments.from_row", "spplanes.Moments.as_row", "spplanes.PlaneMapper.labels"),
    *("factors.copy_graph", "factors.isam2_parameters", "factors.landmark_anchors", "factors.settle"),
    *("factors.isam_covariance", "factors.joint_covariance", "factors.seen_plane", "factors.world_plane"),
    *("factors.Association", "factors.Identity", "factors.LandmarkExtents", "factors.LandmarkExtents.remove"),
    *("factors.Prediction", "factors.Prediction.of_isam", "factors.Prediction.of_marginals"),
    *("factors.Prediction.pose", "factors.Prediction.plane", "factors.Prediction.values_of"),
    *("factors.observation_factor", "factors.LandmarkExtents.change_anchor"),
    *("slam.SlamConfig", "slam.SlamConfig.to_yaml", "slam.PlaneSlam.open"),
    *("slam.PlaneSlam.close", "slam.PlaneSlam.optimize_batch", "slam.PlaneSlam.adopt_batch", "slam.PlaneSlam.remap"),
    *("slam.PlaneSlam.anew", "slam.PlaneSlam.supersede_measured"),
    *("slam.PlaneSlam.supersede", "slam.PlaneSlam.explain", "slam.PlaneSlam.marginal_covariance"),
}


def _read(path: Path) -> None:
    data = path.read_bytes()
    numbers = np.frombuffer(data[: len(data) // 8 * 8], dtype="<f8")
    chosen = numbers[0] if len(numbers) and np.isfinite(numbers[0]) else 0.0
    _check(list(CALLS.values())[int(abs(chosen)) % len(CALLS)](Numbers(numbers[1:])))


def _check(answer: Any) -> None:
    """What holds of every answer of its kind."""
    if isinstance(answer, Plane):
        check_planes(answer)
    elif isinstance(answer, Location):
        check_poses(answer.transform)
        assert np.isfinite(answer.covariance).all()
    elif isinstance(answer, ScanLine):
        assert np.isfinite([answer.alpha, answer.rho, *answer.covariance.ravel()]).all()
    elif isinstance(answer, factors.Association):
        np.testing.assert_allclose([sum(one.probabilities.values()) for one in answer.identities], 1.0)
    elif isinstance(answer, list | tuple):
        for one in answer:
            _check(one)
    elif isinstance(answer, np.ndarray | float):
        assert not np.isnan(answer).any()
    elif isinstance(answer, gtsam.NonlinearFactor | gtsam.NonlinearFactorGraph):
        assert not np.isnan(answer.error(_values()))


def _values() -> gtsam.Values:
    values = gtsam.Values()
    for key in (0, 1):
        values.insert(key, gtsam.Pose3())
        values.insert(key + 2, gtsam.OrientedPlane3(0.0, 0.6, 0.8, 1.0 + key))
        values.insert(key + 4, gtsam.Pose2())
    values.insert(6, gtsam.Pose3())
    return values


def seed_of(number: int, changed: dict[int, float] | None = None) -> bytes:
    """Numbers that one of them takes, but for some at these places."""
    numbers = _numbers_for(list(CALLS)[number])
    numbers[list(changed or {})] = list((changed or {}).values())
    return np.concatenate(([float(number)], numbers)).tobytes()


def _numbers_for(name: str) -> np.ndarray:
    class Asked(Numbers):
        """Gives what will do for each shape, and remembers it."""

        def __init__(self) -> None:
            super().__init__(np.empty(0))
            self.given: list[np.ndarray] = []

        def array(self, *shape: int) -> np.ndarray:
            if shape == (4, 4):
                flat = any(word in name for word in ("ScanLine", "2d", "keyframe", "merge"))
                found = np.eye(4) if flat else room_planes()[len(self.given) % 4].frame
            elif len(shape) == 2 and shape[0] == shape[1]:
                found = 1e-3 * np.eye(shape[0])
            elif len(shape) == 3:
                y, z = np.meshgrid(np.linspace(-1.0, 1.0, shape[1]), np.linspace(0.0, 2.0, shape[0]))
                found = np.stack((np.full(y.shape, 2.0), y, z), axis=2)
            elif shape == (3,):
                found = np.array([0.48, 0.6, 0.64])
            else:
                found = np.random.default_rng(len(self.given)).uniform(0.1, 1.0, shape)
            self.given.append(found)
            return found

    asked = Asked()
    CALLS[name](asked)
    return np.concatenate([one.ravel() for one in asked.given])


PUBLIC = (Target("public", _read, lambda: [seed_of(number) for number in range(len(CALLS))], is_numbers=True),)
