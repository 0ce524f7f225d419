"""Trajectories against truth: absolute error after alignment, relative error over a way, errors of known relations."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from slam.io.raw import read_rows
from slam.io.trajectories import Trajectory, nearest_stamp
from spplanes._check import FloatArray, as_shape


class Metric(NamedTuple):
    """A row of the table that `spplanes evaluate` prints."""

    name: str
    """What was measured."""
    value: float
    """The value; NaN where there was nothing to measure."""
    unit: str
    """Its unit; empty for counts."""


#: Rounds of aligning poses, and errors that count as none in the ratio of the two kinds: 1 mm and 0.01 deg.
_ROUNDS, _NO_SHIFT_M, _NO_TURN_RAD = 8, 1e-3, 1.7e-4

#: Poses of an estimate and of the truth are of one time within this, ns; a relation counts when the trajectory has
#: poses *less* than it from both of its times.
_NEAR_NS = 1_000_000

Alignment = Literal["se3", "se2", "poses", "first", "none"]


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of poses, one by one."""

    translation_m: FloatArray
    """Distance between the positions, shape (N,), m."""
    rotation_rad: FloatArray
    """Angle of the rotation between the poses, shape (N,), rad."""

    def metrics(self, name: str) -> list[Metric]:
        """Root mean square, mean, median and maximum of both."""
        degrees, rows = np.rad2deg(self.rotation_rad), []
        for part, errors, unit in (("translation", self.translation_m, "m"), ("rotation", degrees, "deg")):
            known = errors if errors.size else np.array([np.nan])
            numbers = np.sqrt(np.mean(known**2)), known.mean(), np.median(known), known.max()
            for statistic, value in zip(("rmse", "mean", "median", "max"), numbers, strict=True):
                rows.append(Metric(f"{name} {part} {statistic}", float(value), unit))
        return rows


def pose_errors(errors: FloatArray) -> PoseErrors:
    """Length of translation and angle of rotation of transforms (N, 4, 4)."""
    return PoseErrors(np.linalg.norm(errors[:, :3, 3], axis=1), Rotation.from_matrix(errors[:, :3, :3]).magnitude())


def nearest_stamps(wanted_ns: np.ndarray, stamps_ns: np.ndarray, tolerance_ns: int) -> np.ndarray:
    """Index into ascending `stamps_ns` (M,) of the time nearest to each wanted one (N,); -1: none within tolerance."""
    stamps, wanted = np.asarray(stamps_ns, dtype=np.int64), np.asarray(wanted_ns, dtype=np.int64)
    if stamps.size == 0:
        return np.full(wanted.shape, -1, dtype=np.int64)
    best = nearest_stamp(wanted, stamps)
    return np.where(np.abs(stamps[best] - wanted) <= tolerance_ns, best, -1)


def common_poses(estimate: Trajectory, truth: Trajectory) -> tuple[np.ndarray, FloatArray, FloatArray]:
    """Times (N,) and poses (N, 4, 4) of both where they have one within 1 ms; ValueError: no time in common."""
    places = nearest_stamps(estimate.stamps_ns, truth.stamps_ns, _NEAR_NS)
    found = places >= 0
    if not found.any():
        raise ValueError(
            f"truth: expected times in common with the estimate ({_span(estimate)}), got none within "
            f"{_NEAR_NS * 1e-6:g} ms ({_span(truth)})"
        )
    return estimate.stamps_ns[found], estimate.poses[found], truth.poses[places[found]]


def _span(path: Trajectory) -> str:
    if not len(path):
        return "no poses"
    return f"{len(path)} poses from {path.stamps_ns[0] * 1e-9:.3f} to {path.stamps_ns[-1] * 1e-9:.3f} s"


def align(source: FloatArray, target: FloatArray, *, planar: bool = False) -> FloatArray:
    """target_T_source (4, 4) that brings points (N, 3) closest to points (N, 3), scale 1.

    With `planar` it is a rotation about z and a shift. Points on a line leave the turn about the line open: it is then
    the smallest one.

    References:
        Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 13(4), 1991.
    """
    source, target = as_shape("source", source, (None, 3)), as_shape("target", target, (None, 3))
    from_centre, to_centre = source.mean(axis=0), target.mean(axis=0)
    transform = np.eye(4)
    transform[:3, :3] = _closest_rotation((target - to_centre).T @ (source - from_centre), planar)
    transform[:3, 3] = to_centre - transform[:3, :3] @ from_centre
    return transform


def _closest_rotation(cross: FloatArray, planar: bool) -> FloatArray:
    """The rotation R that maximises trace(R^T cross)."""
    if planar:
        angle = np.arctan2(cross[1, 0] - cross[0, 1], cross[0, 0] + cross[1, 1])
        return Rotation.from_euler("z", angle).as_matrix()
    left, _, right = np.linalg.svd(cross)
    sign = np.diag([1.0, 1.0, np.linalg.det(left) * np.linalg.det(right)])
    return left @ sign @ right


def align_poses(source: FloatArray, target: FloatArray) -> FloatArray:
    """target_T_source (4, 4) that brings poses (N, 4, 4) closest to poses (N, 4, 4), orientations and positions alike.

    Positions alone leave a turn open when they lie on a line, and say little of any turn when the way is short: an
    error of 2 cm over 2 m is 0.6 deg. Orientations tell it as well, each kind of error weighed by its own mean square,
    which is found with the transform in a few rounds.
    """
    from_centre, to_centre = source[:, :3, 3].mean(axis=0), target[:, :3, 3].mean(axis=0)
    cross = (target[:, :3, 3] - to_centre).T @ (source[:, :3, 3] - from_centre)
    turns = np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3])
    transform, metres_per_rad = np.eye(4), np.inf
    for _ in range(_ROUNDS):
        weighed = turns if np.isinf(metres_per_rad) else cross + 0.5 * metres_per_rad**2 * turns
        transform[:3, :3] = _closest_rotation(weighed, planar=False)
        transform[:3, 3] = to_centre - transform[:3, :3] @ from_centre
        errors = pose_errors(np.linalg.inv(target) @ transform @ source)
        turned = max(float(np.sqrt(np.mean(errors.rotation_rad**2))), _NO_TURN_RAD)
        metres_per_rad = max(float(np.sqrt(np.mean(errors.translation_m**2))), _NO_SHIFT_M) / turned
    return transform


def alignment_of(estimated: FloatArray, true: FloatArray, alignment: Alignment) -> FloatArray:
    """truth_T_estimate (4, 4) from poses (N, 4, 4).

    By all positions in space ("se3") or on the floor ("se2"), by all positions and orientations ("poses"), by the first
    pose, or none.
    """
    if alignment == "none":
        return np.eye(4)
    if alignment == "first":
        return true[0] @ np.linalg.inv(estimated[0])
    if alignment == "poses":
        return align_poses(estimated, true)
    if alignment not in ("se3", "se2"):
        raise ValueError(f"alignment: expected 'se3', 'se2', 'poses', 'first' or 'none', got {alignment!r}")
    return align(estimated[:, :3, 3], true[:, :3, 3], planar=alignment == "se2")


def truth_T_estimate(estimate: Trajectory, truth: Trajectory) -> FloatArray:
    """Motion (4, 4) that puts the first pose that both have at one time where it truly was; ValueError: none."""
    _, estimated, true = common_poses(estimate, truth)
    return alignment_of(estimated, true, "first")


def absolute_error(estimate: Trajectory, truth: Trajectory, *, alignment: Alignment = "se3") -> PoseErrors:
    """Absolute trajectory error: truth^-1 aligned estimate, at every time both have; ValueError: none in common."""
    _, estimated, true = common_poses(estimate, truth)
    moved = alignment_of(estimated, true, alignment) @ estimated
    return pose_errors(np.linalg.inv(true) @ moved)


def relative_error(estimate: Trajectory, truth: Trajectory, *, way_m: float = 1.0) -> PoseErrors:
    """Relative pose error: motion of the estimate against motion of the truth over every way of `way_m` (truth's).

    Each pose is paired with the first one at least `way_m` further on. ValueError: no time in common.
    """
    _, estimated, true = common_poses(estimate, truth)
    ways = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1))])
    later = np.searchsorted(ways, ways + way_m)
    first = np.flatnonzero(later < len(ways))
    last = later[first]
    moved = np.linalg.inv(estimated[first]) @ estimated[last]
    really = np.linalg.inv(true[first]) @ true[last]
    return pose_errors(np.linalg.inv(really) @ moved)


@dataclass(frozen=True, eq=False)
class Relations:
    """Relative poses a_T_b between two times each."""

    stamps_ns: np.ndarray
    """Times of a and b, shape (R, 2), int64."""
    a_T_b: FloatArray
    """Pose of the robot at b in its frame at a, shape (R, 4, 4)."""

    def __len__(self) -> int:
        return len(self.stamps_ns)


def read_relations(path: Path | str) -> Relations:
    """Read lines `t1 t2 dx dy dz roll pitch yaw`, plain or gzip; R = Rz(yaw) Ry(pitch) Rx(roll).

    LogError, with file and line: not eight finite numbers, or no relations at all.

    References:
        Kuemmerle et al., "On Measuring the Accuracy of SLAM Algorithms", Autonomous Robots 27(4), 2009.
    """
    stamps, values, _ = read_rows(Path(path), columns=8, stamp_columns=2)
    a_T_b = np.tile(np.eye(4), (len(values), 1, 1))
    a_T_b[:, :3, :3] = Rotation.from_euler("xyz", values[:, 3:]).as_matrix()
    a_T_b[:, :3, 3] = values[:, :3]
    return Relations(stamps, a_T_b)


#: Names of the rows that say how many relations were scored, and how many there are.
FOUND, STATED = "relations found", "relations in the file"


def relation_errors(estimate: Trajectory, relations: Relations) -> PoseErrors:
    """Error of the estimate's relative poses for those relations whose two times it has (Kuemmerle et al.)."""
    first, last = (nearest_stamps(column, estimate.stamps_ns, _NEAR_NS - 1) for column in relations.stamps_ns.T)
    found = (first >= 0) & (last >= 0)
    moved = np.linalg.inv(estimate.poses[first[found]]) @ estimate.poses[last[found]]
    return pose_errors(np.linalg.inv(relations.a_T_b[found]) @ moved)


def relation_metrics(estimate: Trajectory, relations: Relations) -> list[Metric]:
    """How many relations were found (ValueError: none), and the errors; the mean is the figure that is published."""
    errors = relation_errors(estimate, relations)
    if errors.translation_m.size == 0:
        raise ValueError("relations: expected times of the trajectory, got none that agree to 1 ms")
    counts = [Metric(FOUND, errors.translation_m.size, ""), Metric(STATED, len(relations), "")]
    return counts + errors.metrics("relations")
