"""The estimator behind the map: iSAM2, its current estimate, its marginals, and the same graph as a batch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import gtsam
import numpy as np

from slam.clock import StageClock, timed
from slam.config import BackendConfig
from slam.past import PastPose, PastPoses
from spplanes._check import FloatArray

#: The turn of a pose's tangent: none.
_STAYS = np.eye(6)
_POSES = (ord("x"), ord("m"))  # of a keyframe, of a prior map


class BackendError(RuntimeError):
    """The graph cannot be solved; the sentence says near which variable."""


class Backend:
    """iSAM2 with QR elimination.

    QR, because the normal equations of a long corridor square a condition number that is already large: with Cholesky
    iSAM2 gave up after 700 poses of a 1 m step, 1 cm / 0.01 rad odometry and planes that leave one direction open.
    """

    def __init__(self, config: BackendConfig) -> None:
        self._parameters = gtsam.ISAM2Params()
        self._parameters.setFactorization("QR")
        self._parameters.setRelinearizeThreshold(config.relinearize_threshold)
        self._parameters.relinearizeSkip = 1
        self._parameters.cacheLinearizedFactors = True
        self.clock = StageClock()
        self._isam = gtsam.ISAM2(self._parameters)
        self._past = PastPoses()
        self._forget()

    def _forget(self) -> None:
        """The graph has changed: what was read out of it before holds no more."""
        self._whole: gtsam.Values | None = None
        self._poses: dict[int, FloatArray] = {}
        self._planes: dict[int, gtsam.OrientedPlane3] = {}
        self._delta: gtsam.VectorValues | None = None
        self._joint: JointCovariance | None = None

    @property
    def values(self) -> gtsam.Values:
        """Current estimate of every variable: 1 us each, so not for every keyframe."""
        if self._whole is None:
            self._whole = self._isam.calculateEstimate()
        return self._whole

    def values_of(self, keys: Iterable[int]) -> gtsam.Values:
        """Current estimate of some poses and planes."""
        some = gtsam.Values()
        for key in keys:
            some.insert(key, gtsam.Pose3(self.pose(key)) if _is_pose(key) else self.plane(key))
        return some

    @property
    def graph(self) -> gtsam.NonlinearFactorGraph:
        """Every factor still in the graph."""
        graph = gtsam.NonlinearFactorGraph()
        factors = self._isam.getFactorsUnsafe()
        for index in range(factors.size()):
            if factors.at(index) is not None:
                graph.push_back(factors.at(index))
        return graph

    @timed("optimise")
    def update(
        self, factors: Iterable[Any], initial: gtsam.Values, remove: Sequence[int] = (), *, relinearize: bool = False
    ) -> list[int]:
        """Add factors and variables, remove factors by index; returns the indices of the new factors.

        Raises:
            BackendError: the system became indeterminate.
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.push_back(factor)
        try:
            result = self._isam.update(graph, initial, list(remove))
            if relinearize:
                self._isam.update()
        except RuntimeError as error:
            raise BackendError(_first_line(error)) from error
        finally:
            self._forget()
        return list(result.getNewFactorsIndices())

    @timed("optimise")
    def settle(self, rounds: int) -> None:
        """Relinearise a few times over: after something that moved the estimate far."""
        for _ in range(rounds):
            self.update([], gtsam.Values())

    def chi2(self) -> float:
        """Sum of the squared whitened errors of all factors at the current estimate."""
        return 2.0 * float(self.graph.error(self.values))

    def pose(self, key: int) -> FloatArray:
        """world_T_body of a pose variable, shape (4, 4)."""
        if key not in self._poses:
            held = self.holds(key)
            self._poses[key] = (
                self._isam.calculateEstimatePose3(key).matrix() if held else self._past.pose(key, self.pose)
            )
        return self._poses[key]

    def poses(self, keys: Sequence[int]) -> FloatArray:
        """world_T_body of many pose variables, shape (N, 4, 4)."""
        values = self.values
        self._poses |= {key: values.atPose3(key).matrix() for key in keys if key not in self._poses and self.holds(key)}
        return np.array([self.pose(key) for key in keys]).reshape(-1, 4, 4)

    def holds(self, key: int) -> bool:
        """Whether a pose is a variable of the graph; if not, it has left it."""
        return key not in self._past

    @property
    def n_left(self) -> int:
        """How many poses have left the graph."""
        return len(self._past)

    def let_go(self, bases: dict[int, int]) -> None:
        """Remember poses, which are about to leave the graph, each (key) by one that stays (value)."""
        joint = self.joint_covariance(sorted({*bases, *bases.values()}))
        for key, base in bases.items():
            self._past.add(key, PastPose.of(base, self.pose(base), self.pose(key), joint.of([base, key])))

    def plane(self, key: int) -> gtsam.OrientedPlane3:
        """A landmark variable, in its anchor's frame."""
        if key not in self._planes:
            if self._delta is None:
                self._delta = self._isam.getDelta()  # a copy of all of it
            there = self._isam.getLinearizationPoint().atOrientedPlane3(key)
            self._planes[key] = there.retract(self._delta.at(key))
        return self._planes[key]

    @timed("marginals")
    def joint_covariance(self, keys: Sequence[int]) -> JointCovariance:
        """Joint marginal covariance of a few variables, in the tangents of their current estimates.

        What was asked last is kept until the graph changes.
        """
        if self._joint is None or not self._joint.has(keys):
            self._joint = self.read_joint_covariance(keys)
        return self._joint

    def read_joint_covariance(self, keys: Sequence[int]) -> JointCovariance:
        """The same for who looks at the map: made anew and not kept, so bits do not depend on who asked what before."""
        try:
            marginal = self._isam.jointMarginalCovariance(list(keys))
        except RuntimeError as error:
            raise BackendError(_first_line(error)) from error
        return JointCovariance(keys, marginal.fullMatrix(), [self._to_estimate(key) for key in keys])

    @timed("marginals")
    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance of one variable in its GTSAM tangent order, in the tangent of its current estimate."""
        if key in self._past:
            return self._past.covariance(key, self.covariance)
        if self._joint is not None and self._joint.has([key]):
            return self._joint.of([key])
        try:
            marginal = self._isam.marginalCovariance(key)
        except RuntimeError as error:
            raise BackendError(_first_line(error)) from error
        return JointCovariance([key], marginal, [self._to_estimate(key)]).of([key])

    def _to_estimate(self, key: int) -> FloatArray:
        """Matrix that takes a tangent at iSAM2's linearisation point to one at the estimate.

        For a plane the two differ by more than second order: ``Unit3.basis()`` jumps where components of the normal
        tie, so at every floor and every axis-aligned wall the two tangents may be turned by 90 deg. iSAM2's marginals
        are those of its linearisation point.
        """
        if _is_pose(key):
            return _STAYS
        matrix = np.eye(3)
        here, there = self.plane(key), self._isam.getLinearizationPoint().atOrientedPlane3(key)
        matrix[:2, :2] = here.normal().basis().T @ there.normal().basis()
        return matrix

    def optimize_batch(self) -> gtsam.Values:
        """Levenberg-Marquardt on the same factors, started from the current estimate."""
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        return gtsam.LevenbergMarquardtOptimizer(self.graph, self.values, parameters).optimize()

    def rebuild(self, values: gtsam.Values) -> dict[int, int]:
        """Start anew with the same factors from other values; the new index of every factor by its old one."""
        old = self._isam.getFactorsUnsafe()
        kept = [index for index in range(old.size()) if old.at(index) is not None]
        factors = [old.at(index) for index in kept]
        self._isam = gtsam.ISAM2(self._parameters)
        return dict(zip(kept, self.update(factors, values), strict=True))


class JointCovariance:
    """A joint marginal covariance of a few variables, addressed by key."""

    def __init__(self, keys: Sequence[int], marginal: FloatArray, turns: Sequence[FloatArray]) -> None:
        ends = np.cumsum([len(turn) for turn in turns]).tolist()
        self._columns = {key: np.arange(end - len(turn), end) for key, turn, end in zip(keys, turns, ends, strict=True)}
        self._full = np.array(marginal)
        for turn, end in zip(turns, ends, strict=True):
            if turn is not _STAYS:
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


def pose_symbol(index: int) -> int:
    """GTSAM key of the pose of a keyframe."""
    return gtsam.symbol("x", index)


def _is_pose(key: int) -> bool:
    return key >> 56 in _POSES


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split("\n\n")[0].split())
