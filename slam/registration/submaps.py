"""Submaps of a level laser: what it saw along a stretch of the way, compared with what it saw along another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.backend.estimator import Backend
from slam.backend.joint_covariance import motion_covariance
from slam.config import BOUND_SIGMAS, LoopConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy import Raster, view_from
from slam.frontend.odometry import planar_delta
from slam.geometry.frames import inverse
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
