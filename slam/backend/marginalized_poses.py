"""Marginalized poses: those that the graph no longer holds, each fixed to one that it holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.geometry.frames import inverse
from slam.lazy import Rows
from spplanes._check import FloatArray

#: Of a symmetric matrix (6, 6) the upper half.
_UPPER = np.triu_indices(6)


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
    """All of them, by key: as rows of numbers, for of a long mission nearly every pose is one."""

    def __init__(self) -> None:
        #: Key of the base, rows 0 to 2 of where it is from there, what it carries, and the upper half of its spread.
        self._rows = Rows("Q" + (12 + 36 + 21) * "d")
        self._places: dict[int, int] = {}

    def __contains__(self, key: int) -> bool:
        return key in self._places

    def __len__(self) -> int:
        return len(self._places)

    def add(self, key: int, past: PastPose) -> None:
        """Remember one."""
        self._places[key] = len(self._rows)
        self._rows.append((past.base_key, *past.base_T_pose[:3].flat, *past.carry.flat, *past.spread[_UPPER]))

    def at(self, key: int) -> PastPose:
        """One of them."""
        base_key, *numbers = self._rows.at(self._places[key])
        row, base_T_pose, spread = np.array(numbers), np.eye(4), np.empty((6, 6))
        base_T_pose[:3] = row[:12].reshape(3, 4)
        spread[_UPPER] = spread.T[_UPPER] = row[48:]
        return PastPose(base_key, base_T_pose, row[12:48].reshape(6, 6), spread)
