"""Marginalized poses: those that the graph no longer holds, each fixed to one that it holds."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.geometry.frames import inverse
from spplanes._check import FloatArray

#: A key of GTSAM is a letter and a number: that of poses, and the bits of the number.
_POSE, _NUMBER = gtsam.symbol("x", 0) >> 56, (1 << 56) - 1
#: Of a symmetric matrix (6, 6) the upper half.
_UPPER = np.triu_indices(6)
#: Numbers of one past pose, and how many of them are made room for at once.
_NUMBERS, _ROWS = 12 + 36 + 21, 256


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
    """All of them, by key: as numbers in blocks, for of a long mission nearly every pose is one."""

    def __init__(self) -> None:
        self._blocks: list[FloatArray] = []
        #: By the number of the pose: key of its base; 0: it has not left.
        self._bases = array("Q")
        self._count = 0

    def __contains__(self, key: int) -> bool:
        number = key & _NUMBER
        return key >> 56 == _POSE and number < len(self._bases) and self._bases[number] > 0

    def __len__(self) -> int:
        return self._count

    def add(self, key: int, past: PastPose) -> None:
        """Remember one."""
        number, row = key & _NUMBER, self._row(key)
        self._count += key not in self
        self._bases[number] = past.base_key
        row[:12], row[12:48] = past.base_T_pose[:3].ravel(), past.carry.ravel()
        row[48:] = past.spread[_UPPER]

    def pose(self, key: int, pose_of: Callable[[int], FloatArray]) -> FloatArray:
        """world_T_body (4, 4) by the pose of its base now."""
        past = self.at(key)
        return pose_of(past.base_key) @ past.base_T_pose

    def covariance(self, key: int, covariance_of: Callable[[int], FloatArray]) -> FloatArray:
        """Marginal covariance (6, 6) by that of its base now."""
        past = self.at(key)
        return past.covariance(covariance_of(past.base_key))

    def at(self, key: int) -> PastPose:
        """One of them."""
        row, base_T_pose, spread = self._row(key), np.eye(4), np.empty((6, 6))
        base_T_pose[:3] = row[:12].reshape(3, 4)
        spread[_UPPER] = spread.T[_UPPER] = row[48:]
        return PastPose(self._bases[key & _NUMBER], base_T_pose, row[12:48].reshape(6, 6), spread)

    def _row(self, key: int) -> FloatArray:
        number = key & _NUMBER
        while number >= len(self._bases):
            self._bases.append(0)
        while number >= _ROWS * len(self._blocks):
            self._blocks.append(np.empty((_ROWS, _NUMBERS)))
        return self._blocks[number // _ROWS][number % _ROWS]
