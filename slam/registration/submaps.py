"""Submaps of a level laser: what it saw along stretches of the way, and where these are from one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.backend.estimator import Backend, pose_symbol
from slam.config import BOUND_SIGMAS, LoopConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy.raster import Raster, view_from
from slam.frontend.odometry import difference, planar_covariance, planar_delta
from slam.frontend.pose_measurements import PlaceMatch
from slam.geometry.frames import planar_transform
from slam.registration.correlative_search import PlaceView
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class PlanarPose:
    """An uncertain motion in the plane."""

    delta: FloatArray
    """(x, y, theta), shape (3,)."""
    covariance: FloatArray
    """Its covariance, additive, x and y along the axes of the first frame, shape (3, 3)."""

    @classmethod
    def of(cls, old_key: int, key: int, backend: Backend) -> PlanarPose:
        """Where a pose is from an old one by the estimate: by the joint marginal of both."""
        old_T_now, covariance = backend.relative_pose(old_key, key)
        return cls(planar_delta(old_T_now), planar_covariance(covariance, old_T_now))

    @classmethod
    def of_all(cls, ends: Sequence[tuple[int, int]], backend: Backend) -> list[PlanarPose]:
        """Of many pairs (old, now) by one joint marginal: that of twenty poses takes iSAM2 twice as long as of two."""
        if ends:
            backend.joint_covariance(sorted({key for pair in ends for key in pair}))  # kept until the graph changes
        return [cls.of(*pair, backend) for pair in ends]

    @property
    def reach_m(self) -> float:
        """Three sigma of the position in its least known direction, m."""
        return BOUND_SIGMAS * float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[:2, :2])[-1], 0.0)))

    def __matmul__(self, after: PlanarPose) -> PlanarPose:
        """This motion and another one after it, independent of it; covariance to first order."""
        delta = planar_delta(planar_transform(*self.delta) @ planar_transform(*after.delta))
        by_first, by_after = np.eye(3), np.eye(3)
        by_first[:2, 2] = self.delta[1] - delta[1], delta[0] - self.delta[0]
        c, s = np.cos(self.delta[2]), np.sin(self.delta[2])
        by_after[:2, :2] = (c, -s), (s, c)
        spread = by_first @ self.covariance @ by_first.T + by_after @ after.covariance @ by_after.T
        return PlanarPose(delta, spread)

    def chi2(self, other: PlanarPose) -> float:
        """Squared Mahalanobis distance to another one of the same two frames, independent of it; 3 dof."""
        return PlanarPose(self.delta, self.covariance + other.covariance).misfit(other.delta)

    def misfit(self, delta: FloatArray) -> float:
        """Squared Mahalanobis distance to a motion (x, y, theta) that is exact, 3 dof."""
        error = difference(self.delta, delta)
        return float(error @ np.linalg.solve(self.covariance, error))


def anchored(match: PlaceMatch, backend: Backend) -> tuple[int, PlanarPose]:
    """A match by the pose in the graph that the earlier keyframe moves with: its key, and the later one from there."""
    key, base_T_old = backend.rigid_base(pose_symbol(match.keyframe))
    turn = np.eye(3)
    turn[:2, :2] = base_T_old[:2, :2]
    delta = planar_delta(base_T_old @ planar_transform(*match.delta))
    return key, PlanarPose(delta, turn @ match.covariance @ turn.T)


def view_of(
    keyframes: Sequence[Keyframe], poses: Sequence[FloatArray], base: FloatArray, config: LoopConfig
) -> PlaceView | None:
    """The returns of keyframes at some poses in the frame of the pose `base`; None when there are none."""
    seen = [
        (pose, keyframe.returns)
        for pose, keyframe in zip(poses, keyframes, strict=True)
        if keyframe.returns is not None and len(keyframe.returns)
    ]
    if not seen:
        return None
    beams = view_from(base, [pose for pose, _ in seen], [returns for _, returns in seen])
    return PlaceView(Raster.of(beams, config.look_m))
