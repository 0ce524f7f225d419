"""Public functions that take arrays, fed with any floats."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import gtsam
import numpy as np

from factors import line_factor, odometry_factor, plane_factor
from slam import PlaneSlam
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import LineObservation, PlaneObservation
from slam.frontend.odometry import Motion
from spplanes import (
    MapperConfig,
    Plane,
    PlaneMapper,
    ScanLine,
    extract_lines,
    fit_plane,
    fit_planes,
    segment_cloud,
    segment_scans,
)
from tests.fuzz.target import Target, check_plane, check_pose
from tests.slam.scenes import drive, room_planes


def _numbers(path: Path) -> np.ndarray:
    data = path.read_bytes()
    return np.frombuffer(data[: len(data) // 8 * 8], dtype="<f8")


def _first(numbers: np.ndarray) -> float:
    return float(numbers[0]) if len(numbers) else 0.0


def _taken(numbers: np.ndarray, *shapes: tuple[int, ...]) -> list[np.ndarray]:
    """Arrays of these shapes one after another; zeros where the numbers end."""
    sizes = [int(np.prod(shape)) for shape in shapes]
    padded = np.concatenate((numbers, np.zeros(max(sum(sizes) - len(numbers), 0))))
    parts = np.split(padded[: sum(sizes)], np.cumsum(sizes)[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def _fit(path: Path) -> None:
    numbers = _numbers(path)
    points = numbers[1 : 1 + (len(numbers) - 1) // 3 * 3].reshape(-1, 3)
    check_plane(fit_plane(points, sigma=_first(numbers)))


def _fit_covariances(path: Path) -> None:
    """Points with a covariance each, in scans whose poses have one."""
    count = 6
    points, covariances, shared = _taken(_numbers(path), (count, 3), (count, 3, 3), (2, 6, 6))
    check_plane(fit_plane(points, covariances, viewpoint=points[0]))
    check_plane(fit_plane(points, covariances, scan_index=np.arange(count) % 2, pose_covariances=shared))
    for plane in fit_planes(points, covariances, np.zeros(count, dtype=np.int64), method="sp"):
        check_plane(plane)


def _lines(path: Path) -> None:
    numbers = _numbers(path)
    ranges = numbers[1:722]
    angles = np.linspace(-np.pi, np.pi, len(ranges), endpoint=False)
    for line in extract_lines(ranges, angles, sigma=_first(numbers)):
        assert np.isfinite([line.alpha, line.rho, *line.covariance.ravel(), *line.endpoints.ravel()]).all()


def _segment(path: Path) -> None:
    numbers = _numbers(path)[: 1 + 3 * 16 * 16]
    beams = 16
    points = numbers[1 : 1 + (len(numbers) - 1) // (3 * beams) * 3 * beams].reshape(-1, beams, 3)
    labels, planes = segment_scans(points, sigma=_first(numbers), config=MapperConfig())
    assert labels.shape == points.shape[:2] and labels.max(initial=-1) < len(planes)
    for plane in planes:
        check_plane(plane)


def _segment_cloud(path: Path) -> None:
    """The same points without an order; half of them seen from elsewhere."""
    numbers = _numbers(path)[: 1 + 3 * 16 * 16]
    points = numbers[1 : 1 + (len(numbers) - 1) // 3 * 3].reshape(-1, 3)
    viewpoint = points[0] if len(points) % 2 else np.zeros(3)
    labels, planes = segment_cloud(points, sigma=_first(numbers), viewpoint=viewpoint)
    assert labels.shape == points.shape[:1] and labels.max(initial=-1) < len(planes)
    for plane in planes:
        check_plane(plane)


def _mapper(path: Path) -> None:
    """Four scans of twelve beams, each with its covariance."""
    *scans, covariance = _taken(_numbers(path), *[(12, 3)] * 4, (3, 3))
    mapper = PlaneMapper(MapperConfig())
    for points in scans:
        mapper.add_scan(points, np.repeat(covariance[None], 12, axis=0))
    for plane in mapper.planes:
        check_plane(plane)


def _plane_dict(path: Path) -> None:
    try:
        data = json.loads(path.read_bytes())
    except RecursionError as error:
        raise ValueError("too deep") from error
    check_plane(Plane.from_dict(data))


def _two_planes(path: Path) -> None:
    """Two planes moved, compared and merged."""
    first, second, moved, covariance = _taken(_numbers(path), (4, 4), (4, 4), (4, 4), (6, 6))
    a, b = Plane(first, np.eye(3) * 1e-4, 10), Plane(second, covariance[:3, :3], 10)
    check_plane(a.transform(moved, covariance))
    assert a.mahalanobis(b) >= 0.0
    check_plane(a.merge(b))


def _factors(path: Path) -> None:
    """Factors of any numbers: they linearise to numbers."""
    frame, covariance, motion = _taken(_numbers(path), (4, 4), (3, 3), (3,))
    values = gtsam.Values()
    values.insert(0, gtsam.Pose3())
    values.insert(1, gtsam.Pose3())
    values.insert(2, gtsam.OrientedPlane3(0.0, 0.6, 0.8, 1.0))
    line = ScanLine(*motion[:2].tolist(), covariance[:2, :2], frame[:2, :2], np.arange(3), 1.0)
    factors = (
        lambda: plane_factor(Plane(frame, covariance, 10), 0, 2),
        lambda: line_factor(line, frame, 0, 2),
        lambda: odometry_factor(0, 1, motion, covariance),
    )
    problem: ValueError | None = None
    for make in factors:
        try:
            assert not np.isnan(make().error(values))
        except ValueError as error:
            problem = error
    if problem is not None:
        raise problem


def _keyframes(path: Path) -> None:
    """A drive of two keyframes, then one of any numbers, then one that is right again."""
    frame, covariance, step, moved, stamp = _taken(_numbers(path), (4, 4), (3, 3), (4, 4), (3, 3), (1,))
    known = _drive()
    slam = PlaneSlam()
    for keyframe in known[:2]:
        slam.add_keyframe(keyframe)
    before = len(slam.keyframes)
    problem: ValueError | None = None
    try:
        line = ScanLine(*step[0, :2].tolist(), covariance[:2, :2], frame[:2, :2], np.arange(3), 1.0)
        seen = [PlaneObservation(Plane(frame, covariance, 10)), LineObservation(line, frame)]
        later = known[1].stamp_ns + int(np.clip(np.nan_to_num(stamp[0]), -1e9, 5e8))
        slam.add_keyframe(Keyframe(later, seen, Motion(step, moved, (1e-3, 1e-3, 1e-3))))
    except ValueError as error:
        problem = error
        assert len(slam.keyframes) == before, "a keyframe that was refused left a trace"
    slam.add_keyframe(known[2])
    for pose in slam.trajectory.poses:
        check_pose(pose)
    if problem is not None:
        raise problem


@cache
def _drive() -> list[Keyframe]:
    return drive(0, count=4).keyframes


def _numbers_seeds(*shapes: tuple[int, ...]) -> list[bytes]:
    rng = np.random.default_rng(0)
    return [np.concatenate(([0.01], 1.0 + 0.01 * rng.standard_normal(shape).ravel())).tobytes() for shape in shapes]


def _wall_seeds() -> list[bytes]:
    y, z = np.meshgrid(np.linspace(-1, 1, 16), np.linspace(0, 2, 12))
    wall = np.stack((np.full(y.shape, 2.0), y, z), axis=2)
    return [np.concatenate(([0.01], wall.ravel())).tobytes(), *_numbers_seeds((4, 16, 3))]


def _packed(*arrays: np.ndarray) -> bytes:
    return np.concatenate([np.asarray(array, dtype=np.float64).ravel() for array in arrays]).tobytes()


def _fit_seeds() -> list[bytes]:
    points = np.random.default_rng(0).normal(size=(6, 3)) * (1.0, 1.0, 0.01)
    return [_packed(points, np.repeat(1e-4 * np.eye(3)[None], 6, axis=0), np.repeat(1e-6 * np.eye(6)[None], 2, axis=0))]


def _scan_seeds() -> list[bytes]:
    beams = np.stack((np.linspace(0.0, 1.0, 12), np.zeros(12), np.full(12, 2.0)), axis=1)
    return [_packed(*(beams + np.array((0.0, 0.1 * k, 0.0)) for k in range(4)), 1e-4 * np.eye(3))]


def _plane_seeds() -> list[bytes]:
    first = second = room_planes()[0]
    return [_packed(first.frame, second.frame, np.eye(4), 1e-4 * np.eye(6))]


def _frame_seeds() -> list[bytes]:
    frame = room_planes()[2].frame
    step = np.eye(4)
    step[0, 3] = 0.4
    return [_packed(frame, 1e-4 * np.eye(3), step, 1e-4 * np.eye(3), [5e8])]


def _factor_seeds() -> list[bytes]:
    return [_packed(room_planes()[2].frame, 1e-4 * np.eye(3), [0.5, 1.0, 0.2])]


FUNCTIONS = (
    Target("fit_plane", _fit, lambda: _numbers_seeds((9, 3), (3, 3)), is_numbers=True),
    Target("fit_plane-covariances", _fit_covariances, _fit_seeds, is_numbers=True),
    Target("extract_lines", _lines, lambda: _numbers_seeds((90,), (7,)), is_numbers=True),
    Target("segment_scans", _segment, _wall_seeds, is_numbers=True),
    Target("segment_cloud", _segment_cloud, _wall_seeds, is_numbers=True),
    Target("PlaneMapper", _mapper, _scan_seeds, is_numbers=True),
    Target("Plane.from_dict", _plane_dict, lambda: [json.dumps(room_planes()[0].to_dict()).encode()]),
    Target("Plane", _two_planes, _plane_seeds, is_numbers=True),
    Target("factors", _factors, _factor_seeds, is_numbers=True),
    Target("add_keyframe", _keyframes, _frame_seeds, is_numbers=True),
)
