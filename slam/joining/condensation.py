"""Condensation: a mission's graph as a Gaussian on the variables it shares, exact at the point of linearisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Gaussian:
    """|root x - right|^2 of stacked tangents, as numbers alone: this is what travels."""

    keys: tuple[int, ...]
    """The variables, in the order of the columns."""
    root: FloatArray
    """Square root of the information, shape (R, C)."""
    right: FloatArray
    """Right-hand side, shape (R,)."""

    @classmethod
    def of(cls, graph: gtsam.GaussianFactorGraph) -> Gaussian:
        """All factors of a linear graph as one."""
        if not graph.size():
            return cls((), np.empty((0, 0)), np.empty(0))
        factor = gtsam.JacobianFactor(graph)
        keys = [int(key) for key in factor.keys()]  # noqa: SIM118 - not a mapping
        root, right = factor.jacobian()
        return cls(tuple(keys), np.array(root), np.array(right))

    def renamed(self, names: dict[int, int]) -> Gaussian:
        """The same of variables with other keys."""
        return replace(self, keys=tuple(names[key] for key in self.keys))

    def factor(self) -> gtsam.CustomFactor:
        """As a factor, linear at whatever values it is linearised at."""
        sizes = [_size(key) for key in self.keys]
        ends = np.cumsum(sizes).tolist()
        blocks = [self.root[:, end - size : end] for size, end in zip(sizes, ends, strict=True)]
        right = -self.right

        def error(_: gtsam.CustomFactor, __: gtsam.Values, jacobians: Any) -> FloatArray:
            if jacobians is not None:
                for i, block in enumerate(blocks):
                    jacobians[i] = block
            return right

        return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(right)), list(self.keys), error)


@dataclass(frozen=True, eq=False)
class Condensed:
    """A linear graph, such as a mission at one point of linearisation: what it shares, and the rest given that."""

    shared: Gaussian
    """On the variables that were kept."""
    rest: gtsam.GaussianBayesNet
    """All others, given these."""

    def back_substituted(self, shared: gtsam.VectorValues) -> tuple[gtsam.VectorValues, float]:
        """Steps of all variables by those of the shared ones, and the largest of the others in standard deviations.

        The deviations are those when all later ones in the elimination are known: less than the marginal ones.
        """
        steps = self.rest.optimize(shared)
        largest = 0.0
        for index in range(self.rest.size()):
            one = self.rest.at(index)
            largest = max(largest, float(np.linalg.norm(one.R() @ steps.at(one.firstFrontalKey()))))
        return steps, largest


def condense(linear: gtsam.GaussianFactorGraph, keep: Sequence[int]) -> Condensed:
    """Eliminate all variables of a linear graph but some, by QR.

    References:
        Ni, Steedly, Dellaert, "Tectonic SAM", ICRA 2007, for submaps condensed onto what they share.
    """
    rest = sorted(set(linear.keys()).difference(keep))
    if not rest:
        return Condensed(Gaussian.of(linear), gtsam.GaussianBayesNet())
    net, remaining = linear.eliminatePartialSequential(rest, gtsam.EliminateQR)
    return Condensed(Gaussian.of(remaining), net)


class Solved:
    """A linear graph solved by QR: the step of every variable, and the joint covariance of any of them."""

    def __init__(self, graph: gtsam.GaussianFactorGraph) -> None:
        net = graph.eliminateSequential(gtsam.Ordering.ColamdGaussianFactorGraph(graph), gtsam.EliminateQR)
        self.steps: gtsam.VectorValues = net.optimize()
        self._rows: dict[int, slice] = {}
        end = 0
        for index in range(net.size()):
            key = net.at(index).firstFrontalKey()
            self._rows[key] = slice(end, end + _size(key))
            end += _size(key)
        # GTSAM's own marginals go by normal equations, which the tightest and the widest prior of one graph overtax
        root, _ = net.matrix()
        self._inverse = np.asarray(solve_triangular(root, np.eye(end)), dtype=np.float64)

    def covariance(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of the stacked tangents of some variables, in that order."""
        rows = np.concatenate([self._inverse[self._rows[key]] for key in keys])
        return rows @ rows.T

    def largest(self) -> float:
        """The largest step of any variable in its standard deviations."""
        steps = ((self.steps.at(key), self.covariance([key])) for key in self._rows)
        return max((float(np.sqrt(step @ np.linalg.solve(spread, step))) for step, spread in steps), default=0.0)


def _size(key: int) -> int:
    """Dimension of a variable: of a pose (of a keyframe, a prior map, a mission's base) 6, of a plane 3."""
    return 6 if chr(key >> 56) in "xmb" else 3
