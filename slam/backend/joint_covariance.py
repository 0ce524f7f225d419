"""A joint marginal covariance, and which rows of it are of which variable."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy

import gtsam
import numpy as np

from factors._conventions import POSE3_TO_SP
from spplanes._check import FloatArray

#: The turn of a pose's tangent: none.
STAYS = np.eye(6)


class JointCovariance:
    """A joint marginal covariance of a few variables, addressed by key."""

    def __init__(self, keys: Sequence[int], marginal: FloatArray, turns: Sequence[FloatArray]) -> None:
        ends = np.cumsum([len(turn) for turn in turns]).tolist()
        self._columns = {key: np.arange(end - len(turn), end) for key, turn, end in zip(keys, turns, ends, strict=True)}
        self._full = np.array(marginal)
        for turn, end in zip(turns, ends, strict=True):
            if turn is not STAYS:
                block = slice(end - len(turn), end)
                self._full[block] = turn @ self._full[block]
                self._full[:, block] = self._full[:, block] @ turn.T

    def has(self, keys: Iterable[int]) -> bool:
        """Whether it is of all these keys, and maybe of more."""
        return all(key in self._columns for key in keys)

    def plus(self, effects: FloatArray) -> JointCovariance:
        """With what independent errors of variance 1 do to the variables, rows as those of `full`, shape (D, K)."""
        more = copy(self)
        more._full = self._full + effects @ effects.T
        return more

    @property
    def full(self) -> FloatArray:
        """The whole matrix, in the order of the keys it was asked for."""
        return self._full

    def columns(self, keys: Sequence[int]) -> np.ndarray:
        """Rows and columns of the stacked tangents of `keys`, in that order."""
        return np.concatenate([self._columns[key] for key in keys])

    def of(self, keys: Sequence[int]) -> FloatArray:
        """Covariance of the stacked tangents of `keys`, in that order."""
        columns = self.columns(keys)
        return self._full[np.ix_(columns, columns)]


def relative_covariance(a_T_b: FloatArray, joint: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a_T_b, SP order along b's axes, from that of both poses' tangents (12, 12)."""
    jacobian = np.hstack((-gtsam.Pose3(a_T_b).inverse().AdjointMap(), np.eye(6)))
    return (jacobian @ joint @ jacobian.T)[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]


def motion_covariance(a_T_b: FloatArray, joint: FloatArray) -> FloatArray:
    """Covariance (3, 3) of (x, y, theta) of a_T_b, x and y along a's axes, from that of both tangents (12, 12)."""
    in_b = relative_covariance(a_T_b, joint)[np.ix_([0, 1, 3], [0, 1, 3])]
    turn = np.eye(3)
    turn[:2, :2] = a_T_b[:2, :2]
    return turn @ in_b @ turn.T
