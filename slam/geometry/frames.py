"""Rigid transforms of a run: inverse, nearest rotation, frames of planes, poses on the floor and of quaternions."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from spplanes._check import FloatArray
from spplanes.outlines.extents import lift as lift
from spplanes.outlines.extents import settle_frames
from spplanes.spmodel import inverse_transform as inverse

#: A quaternion, a normal or a rotation that somebody wrote down may miss unit norm by this much: four digits.
NORM_TOLERANCE = 1e-3


def orthonormal(transform: FloatArray) -> FloatArray:
    """The rigid transform (4, 4) nearest to one whose rotation has lost its shape by rounding.

    A motion predicted from the two poses before doubles what they are off: without this, poses of a run without
    odometry were no rotations any more, to 1e-6, after some forty keyframes.
    """
    u, _, v = np.linalg.svd(transform[:3, :3])
    settled = transform.copy()
    settled[:3, :3] = u @ v
    return settled


def settle_frame(frame: FloatArray, normal: FloatArray, d: float) -> FloatArray:
    """The plane frame nearest to `frame` on the plane normal.x = d: origin projected, x axis kept as far as it can be.

    Args:
        frame: Plane frame to start from, shape (4, 4).
        normal: Unit normal, shape (3,), less than 90 deg from the frame's z axis.
        d: Hesse distance, m.
    """
    return settle_frames(frame[None], normal[None], np.array([d]))[0]


def planar_transform(x: float, y: float, theta: float) -> FloatArray:
    """(4, 4) transform of a pose on the floor."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def angle_of(transform: FloatArray) -> float:
    """By how much a transform (4, 4) turns, rad."""
    return float(np.arccos(np.clip(0.5 * (np.trace(transform[:3, :3]) - 1.0), -1.0, 1.0)))


def are_apart(a: FloatArray, b: FloatArray, metres: float, radians: float) -> bool:
    """Whether two poses (4, 4) are so far from each other, or turned by so much."""
    step = inverse(a) @ b
    return bool(np.linalg.norm(step[:3, 3]) >= metres or angle_of(step) >= radians)


def way_to(poses: FloatArray) -> FloatArray:
    """Length of the way on the floor from the first of some poses (N, 4, 4) to each, m, shape (N,)."""
    steps = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))


def evenly(count: int, most: int) -> list[int]:
    """Indices of at most so many of `count` elements, evenly over all of them: the sample of a long run is as good."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()


def norms_of(quaternions: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Norms (N,) of quaternions (N, 4), and which of them (N,) are no unit: infinite and NaN are none either."""
    with np.errstate(over="ignore", invalid="ignore"):
        norms = np.linalg.norm(quaternions, axis=1)
    return norms, ~(np.abs(norms - 1.0) <= NORM_TOLERANCE)


def poses_of(numbers: FloatArray) -> FloatArray:
    """Rows x y z qx qy qz qw (N, 7) as transforms (N, 4, 4); the quaternions are normalised.

    Raises:
        ValueError: a position that is not finite, or a quaternion that is none; the sentence has the first one's norm.
    """
    norms, wrong = norms_of(numbers[:, 3:])
    for bad in np.flatnonzero(wrong)[:1]:
        raise ValueError(f"expected a unit quaternion, got one of norm {norms[bad]:.6g}")
    if not np.isfinite(numbers[:, :3]).all():
        raise ValueError("expected finite positions, got NaN or infinity")
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(numbers[:, 3:]).as_matrix()
    poses[:, :3, 3] = numbers[:, :3]
    return poses
