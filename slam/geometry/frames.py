"""Small rigid-frame helpers of the run: inverse, moving points, plane frames that follow an estimate."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes.outlines.growing import lift
from spplanes.spmodel import inverse_transform as inverse

__all__ = ["inverse", "lift", "orthonormal", "settle_frame"]


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
    settled = np.eye(4)
    x_axis = frame[:3, 0] - normal * (normal @ frame[:3, 0])
    x_axis = x_axis / np.linalg.norm(x_axis)
    settled[:3, :3] = np.column_stack((x_axis, np.cross(normal, x_axis), normal))
    origin = frame[:3, 3]
    settled[:3, 3] = origin + normal * (d - normal @ origin)
    return settled


def planar_transform(x: float, y: float, theta: float) -> FloatArray:
    """(4, 4) transform of a pose on the floor."""
    c, s = np.cos(theta), np.sin(theta)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def way_to(poses: FloatArray) -> FloatArray:
    """Length of the way on the floor from the first of some poses (N, 4, 4) to each, m, shape (N,)."""
    steps = np.linalg.norm(np.diff(poses[:, :2, 3], axis=0), axis=1)
    return np.concatenate(([0.0], np.cumsum(steps)))
