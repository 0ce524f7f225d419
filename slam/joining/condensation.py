"""Condensation: a mission's graph as a Gaussian on the variables it shares, exact at the point of linearisation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Condensed:
    """A linear graph, such as a mission at one point of linearisation: what it shares, and the rest given that."""

    shared: gtsam.JacobianFactor
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
    net, remaining = gtsam.GaussianBayesNet(), linear
    if rest:
        net, remaining = linear.eliminatePartialSequential(rest, gtsam.EliminateQR)
    return Condensed(gtsam.JacobianFactor(remaining) if remaining.size() else gtsam.JacobianFactor(), net)


def renamed(factor: gtsam.JacobianFactor, names: Mapping[int, int]) -> gtsam.NonlinearFactor:
    """A linear factor over variables of other keys; it is the same wherever it is linearised."""
    return gtsam.LinearContainerFactor(factor).rekey([names[key] for key in factor.keys()])  # noqa: SIM118


class Solved:
    """A linear graph solved by QR: the step of every variable, and the joint covariance of any of them."""

    def __init__(self, graph: gtsam.GaussianFactorGraph) -> None:
        net = graph.eliminateSequential(gtsam.Ordering.ColamdGaussianFactorGraph(graph), gtsam.EliminateQR)
        self.steps: gtsam.VectorValues = net.optimize()
        self._rows: dict[int, slice] = {}
        end = 0
        for index in range(net.size()):
            key = net.at(index).firstFrontalKey()
            first, end = end, end + len(self.steps.at(key))
            self._rows[key] = slice(first, end)
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
