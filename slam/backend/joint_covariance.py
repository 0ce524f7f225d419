"""Joint marginal covariances: which rows are of which variable, of relative poses, and with what all factors share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from factors._conventions import POSE3_TO_SP
from factors.association.estimate import KeyedCovariance
from slam.frontend.odometry import planar_covariance
from spplanes._check import FloatArray

#: The turn of a pose's tangent: none.
STAYS = np.eye(6)


class JointCovariance(KeyedCovariance):
    """A joint marginal covariance of a few variables, each turned into another tangent."""

    def __init__(self, keys: Sequence[int], marginal: FloatArray, turns: Sequence[FloatArray]) -> None:
        super().__init__(keys, np.array(marginal), [len(turn) for turn in turns])
        for key, turn in zip(keys, turns, strict=True):
            if turn is not STAYS:
                block = slice(self._columns[key][0], self._columns[key][-1] + 1)
                self.full[block] = turn @ self.full[block]
                self.full[:, block] = self.full[:, block] @ turn.T

    def has(self, keys: Iterable[int]) -> bool:
        """Whether it is of all these keys, and maybe of more."""
        return all(key in self._columns for key in keys)

    def plus(self, effects: FloatArray) -> JointCovariance:
        """With what independent errors of variance 1 do to the variables, rows as those of `full`, shape (D, K)."""
        more = copy(self)
        more.full = self.full + effects @ effects.T
        return more


def relative_covariance(a_T_b: FloatArray, joint: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a_T_b, SP order along b's axes, from that of both poses' tangents (12, 12)."""
    jacobian = np.hstack((-gtsam.Pose3(a_T_b).inverse().AdjointMap(), np.eye(6)))
    return (jacobian @ joint @ jacobian.T)[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]


def carried(covariance: FloatArray, a_T_b: FloatArray) -> FloatArray:
    """The covariance (6, 6) of a pose, SP order along its axes, as that of one fixed to it at a_T_b (4, 4)."""
    adjoint = gtsam.Pose3(a_T_b).inverse().AdjointMap()[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
    return adjoint @ covariance @ adjoint.T


def motion_covariance(a_T_b: FloatArray, joint: FloatArray) -> FloatArray:
    """Covariance (3, 3) of (x, y, theta) of a_T_b, x and y along a's axes, from that of both tangents (12, 12)."""
    return planar_covariance(relative_covariance(a_T_b, joint), a_T_b)


@dataclass(frozen=True, eq=False)
class SharedUnknown:
    """Considered, not estimated: the graph goes on with a value of it, and covariances hold how unsure that is.

    References:
        Schmidt, "Application of state-space methods to navigation problems", Adv. Control Systems 3, 1966.
    """

    information: FloatArray
    """What the graph says of it, all other variables eliminated, shape (K, K)."""
    vector: FloatArray
    """The same: the information vector, shape (K,)."""
    _solutions: tuple[gtsam.VectorValues, ...]
    """The graph solved for the unknown at the origin, and at 1 along each of its axes."""
    _root: FloatArray | None = None
    """A root (K, K) of its covariance."""

    @classmethod
    def of(cls, key: int, linear: gtsam.GaussianFactorGraph) -> SharedUnknown:
        """Out of a linear graph that has it as a variable."""
        order = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, [key])
        others = gtsam.Ordering([order.at(position) for position in range(order.size() - 1)])
        net, rest = linear.eliminatePartialSequential(others, gtsam.EliminateQR)
        information, vector = rest.hessian()
        solutions = []
        for value in (np.zeros(len(vector)), *np.eye(len(vector))):
            given = gtsam.VectorValues()
            given.insert(key, value)
            solutions.append(net.optimize(given))
        return cls(information, vector, tuple(solutions))

    def posterior(self, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (K,) and covariance (K, K) of it by the graph and a prior of mean nought, which may know parts of it."""
        covariance = prior @ np.linalg.inv(np.eye(len(prior)) + self.information @ prior)
        return covariance @ self.vector, covariance

    def known(self, covariance: FloatArray) -> SharedUnknown:
        """With a covariance (K, K)."""
        values, vectors = np.linalg.eigh(covariance)  # of a part of it nothing may be unknown
        return replace(self, _root=vectors * np.sqrt(np.maximum(values, 0.0)))

    def effect_on(self, key: int) -> FloatArray:
        """What errors of variance 1 in each axis of its covariance's root do to a variable's tangent, shape (D, K)."""
        assert self._root is not None, "of unknown covariance"
        there, *moved = (solution.at(key) for solution in self._solutions)
        return np.column_stack([one - there for one in moved]) @ self._root
