"""A joint marginal covariance, and which rows of it are of which variable."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

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
