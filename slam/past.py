"""Poses that the graph no longer holds, each fixed to one that it holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam.frames import inverse
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class PastPose:
    """A pose that has left the graph: it moves with its base from then on."""

    base_key: int
    """Key of the pose that it moves with."""
    base_T_pose: FloatArray
    """Where it was from there when it left, shape (4, 4)."""
    carry: FloatArray
    """What a change of the base's tangent told of its own, shape (6, 6)."""
    spread: FloatArray
    """Covariance of its tangent when the base is known, shape (6, 6)."""

    @classmethod
    def of(cls, base_key: int, world_T_base: FloatArray, world_T_pose: FloatArray, joint: FloatArray) -> PastPose:
        """From the estimate of both and the joint covariance (12, 12) of their tangents, the base's first."""
        carry = np.asarray(np.linalg.solve(joint[:6, :6], joint[:6, 6:]).T, dtype=np.float64)
        spread = joint[6:, 6:] - carry @ joint[:6, 6:]
        return cls(base_key, inverse(world_T_base) @ world_T_pose, carry, 0.5 * (spread + spread.T))

    def covariance(self, of_base: FloatArray) -> FloatArray:
        """Its marginal covariance (6, 6) by that of its base now."""
        return self.carry @ of_base @ self.carry.T + self.spread


class PastPoses:
    """All of them, by key."""

    def __init__(self) -> None:
        self._poses: dict[int, PastPose] = {}

    def __contains__(self, key: object) -> bool:
        return key in self._poses

    def __len__(self) -> int:
        return len(self._poses)

    def add(self, key: int, past: PastPose) -> None:
        """Remember one."""
        self._poses[key] = past

    def pose(self, key: int, pose_of: Callable[[int], FloatArray]) -> FloatArray:
        """world_T_body (4, 4) by the pose of its base now."""
        past = self._poses[key]
        return pose_of(past.base_key) @ past.base_T_pose

    def covariance(self, key: int, covariance_of: Callable[[int], FloatArray]) -> FloatArray:
        """Marginal covariance (6, 6) by that of its base now."""
        past = self._poses[key]
        return past.covariance(covariance_of(past.base_key))
