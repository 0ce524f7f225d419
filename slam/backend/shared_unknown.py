"""An unknown that many factors share and that is no variable of the graph: what is known of it, and what it does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from spplanes._check import FloatArray


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
        others = gtsam.Ordering()
        for position in range(order.size() - 1):
            others.push_back(order.at(position))
        net, rest = linear.eliminatePartialSequential(others, gtsam.EliminateQR)
        information, vector = rest.hessian()
        solutions = []
        for value in (np.zeros(len(vector)), *np.eye(len(vector))):
            given = gtsam.VectorValues()
            given.insert(key, value)
            solutions.append(net.optimize(given))
        return cls(information, vector, tuple(solutions))

    def known(self, covariance: FloatArray) -> SharedUnknown:
        """With a covariance (K, K)."""
        return replace(self, _root=np.linalg.cholesky(covariance))

    def effect_on(self, key: int) -> FloatArray:
        """What errors of variance 1 in each axis of its covariance's root do to a variable's tangent, shape (D, K)."""
        assert self._root is not None, "of unknown covariance"
        there, *moved = (solution.at(key) for solution in self._solutions)
        return np.column_stack([one - there for one in moved]) @ self._root
