"""Push-broom windows: poses of the scans relative to the keyframe, and how their errors hang together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.frontend.odometry import OdometryTrack, planar_delta
from slam.geometry.frames import inverse
from spplanes._check import FloatArray


def window_poses(stamps_ns: Sequence[int], keyframe_ns: int, track: OdometryTrack) -> tuple[FloatArray, FloatArray]:
    """Poses of the body at several times, in the body frame at the keyframe.

    Returns:
        kf_T_body (S, 4, 4), and the joint covariance (6 S, 6 S) of their errors, each in the SP order
        (x, y, z, phi, theta, psi), composed on the world side: rotations about the keyframe's origin.

    Odometry is a random walk: the error of a scan is the sum of the errors of all steps between it and the keyframe.
    On the world side a step's error is the same for every scan beyond it, so the covariance of two scans on the same
    side of the keyframe is that of the nearer one, and scans on different sides are independent.
    """
    poses = track.poses_at([keyframe_ns, *stamps_ns])
    relative = inverse(poses[0]) @ poses[1:]
    stamps = np.asarray(stamps_ns, dtype=np.int64)
    count = len(stamps)
    joint = np.zeros((count, 6, count, 6))
    for side in (stamps < keyframe_ns, stamps >= keyframe_ns):
        members = np.flatnonzero(side)
        outward = members[np.argsort(np.abs(stamps[members] - keyframe_ns), kind="stable")]
        walked = _walk(
            [keyframe_ns, *stamps[outward].tolist()], np.concatenate(([np.eye(4)], relative[outward])), track
        )
        for i, row in enumerate(outward):
            for j, column in enumerate(outward):
                joint[row, :, column, :] = walked[min(i, j)]
    return relative, joint.reshape(6 * count, 6 * count)


def _walk(stamps_ns: Sequence[int], poses: FloatArray, track: OdometryTrack) -> list[FloatArray]:
    """Covariance (6, 6), on the world side, after each step away from the first pose."""
    total = np.zeros((6, 6))
    covariances = []
    for index in range(1, len(stamps_ns)):
        forward = stamps_ns[index] > stamps_ns[index - 1]
        base = poses[index - 1] if forward else poses[index]
        tip = poses[index] if forward else poses[index - 1]
        delta = planar_delta(inverse(base) @ tip)
        total = total + _step_covariance(base, tip, track.step_covariance(delta))
        covariances.append(total)
    return covariances


def _step_covariance(base: FloatArray, tip: FloatArray, planar: FloatArray) -> FloatArray:
    """A step's covariance of (x, y, theta), additive in the axes of `base`, as that of a world-side perturbation.

    Translation acts along base's axes; the rotation turns everything beyond about the step's end, so about the origin
    it also shifts by -theta z x tip. Its sign, which depends on the direction of the walk, cancels in the covariance.
    """
    lever = np.cross([0.0, 0.0, 1.0], tip[:3, 3])
    jacobian = np.zeros((6, 3))
    jacobian[:3, :2] = base[:3, :2]
    jacobian[:3, 2] = -lever
    jacobian[3, 2] = 1.0
    return jacobian @ planar @ jacobian.T
