"""Submaps of a level laser: what it saw along a stretch of the way, compared with what it saw along another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.backend.estimator import Backend, pose_symbol
from slam.backend.joint_covariance import motion_covariance
from slam.config import BOUND_SIGMAS, LoopConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy import CELL_M, Raster, view_from
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.registration.scan_matching import relocate
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Where a keyframe is from an old one by the estimate."""

    delta: FloatArray
    """(x, y, theta), shape (3,)."""
    covariance: FloatArray
    """Its covariance, shape (3, 3), x and y along the axes of the old one."""

    @classmethod
    def of(cls, old_key: int, key: int, backend: Backend) -> RelativePose:
        """By the joint marginal of both."""
        old_T_now = inverse(backend.pose(old_key)) @ backend.pose(key)
        joint = backend.joint_covariance([old_key, key]).of([old_key, key])
        return cls(planar_delta(old_T_now), motion_covariance(old_T_now, joint))

    @classmethod
    def of_all(cls, ends: Sequence[tuple[int, int]], backend: Backend) -> list[RelativePose]:
        """Of many pairs (old, now) by one joint marginal: that of twenty poses takes iSAM2 twice as long as of two."""
        if ends:
            backend.joint_covariance(sorted({key for pair in ends for key in pair}))  # kept until the graph changes
        return [cls.of(*pair, backend) for pair in ends]

    @property
    def reach_m(self) -> float:
        """Three sigma of the position in its least known direction, m."""
        return BOUND_SIGMAS * float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[:2, :2])[-1], 0.0)))


def view_of(
    keyframes: Sequence[Keyframe], poses: Sequence[FloatArray], base: FloatArray, config: LoopConfig
) -> Raster | None:
    """The returns of keyframes at some poses in the frame of the pose `base`; None when there are none."""
    seen = [
        (pose, keyframe.returns)
        for pose, keyframe in zip(poses, keyframes, strict=True)
        if keyframe.returns is not None and len(keyframe.returns)
    ]
    if not seen:
        return None
    return Raster.of(view_from(base, [pose for pose, _ in seen], [returns for _, returns in seen]), config.look_m)


def step_by_view(
    keyframe: Keyframe, motion: Motion, keyframes: Sequence[Keyframe], backend: Backend, config: LoopConfig
) -> Motion | None:
    """The motion to a keyframe from the one before, by odometry and by all its returns in what was seen of late.

    For telling walls apart only: the returns are those the lines are made of, so as a factor they would count twice.
    None where there is no level laser, or the returns do not fit anything in one way alone.
    """
    if not motion.is_planar or keyframe.returns is None or not len(keyframe.returns):
        return None
    members, poses = _recent(len(keyframes) - 1, backend, config.window_m)
    recent = view_of([keyframes[one] for one in members], poses, poses[-1], config)
    if recent is None:
        return None
    delta = planar_delta(motion.a_T_b)
    reach = BOUND_SIGMAS * np.sqrt(np.diag(motion.covariance)) + (CELL_M, CELL_M, CELL_M / config.window_m)
    found = relocate(Raster.of(keyframe.returns, config.look_m), recent, delta, motion.covariance, reach)
    if found.share < 1.0 - config.significance:
        return None
    return replace(motion, a_T_b=planar_transform(*found.pose), covariance=found.covariance)


def _recent(last: int, backend: Backend, window_m: float) -> tuple[list[int], list[FloatArray]]:
    """The keyframes within a window of travel before the last one and itself, in time order, and their poses."""
    members, poses, way = [last], [backend.pose(pose_symbol(last))], 0.0
    for index in range(last - 1, -1, -1):
        pose = backend.pose(pose_symbol(index))
        way += float(np.linalg.norm(pose[:3, 3] - poses[-1][:3, 3]))
        if way > window_m:
            break
        members.append(index)
        poses.append(pose)
    return members[::-1], poses[::-1]
