"""The back end: iSAM2, its current estimate, its marginals, and the same graph as a batch."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import cho_factor, get_lapack_funcs

from factors import isam2_parameters
from slam.backend.joint_covariance import STAYS, JointCovariance, SharedUnknown
from slam.backend.marginalized_poses import PastPose, PastPoses
from slam.config import BackendConfig
from slam.timing import StageClock, timed
from spplanes._check import FloatArray

_POSES = ("x", "m")  # letters of their symbols: of a keyframe, of a prior map
_POSE_CODES = {ord(letter) for letter in _POSES}
#: All variables that have moved are relinearised at one of so many updates, two of which a keyframe takes; those in use
#: at every one. An odd number: it falls on predictions and on what is seen in turn.
_ALL_EVERY = 21
#: Variables of so many updates and questions stay where the tree begins: about three keyframes.
_RECENT = 10
#: Of more variables than this a joint covariance is read from the graph.
_MANY = 64
#: What GTSAM says, in Python by a RuntimeError as any other, when elimination fails.
INDETERMINATE = "Indeterminate linear system"
#: Arguments of an update that adds and removes nothing.
_NOTHING = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
_invert_factored = get_lapack_funcs("potri", dtype=np.float64)


class BackendError(RuntimeError):
    """The graph cannot be solved; the sentence says near which variable."""


class Backend:
    """iSAM2 that eliminates by Cholesky's method, and by QR from where that gives up.

    Cholesky takes a third of QR's time. Normal equations square a condition number that long corridors make large:
    after 300 poses of a 1 m step, 1 cm / 0.01 rad odometry, and walls and floors of 50 m, GTSAM calls them
    indeterminate. Up to there the covariances of the two are the same to eight digits.
    """

    def __init__(self, config: BackendConfig) -> None:
        self._thresholds = _thresholds(config)
        self.clock = StageClock()
        self._isam = self._empty("CHOLESKY")
        self._past = PastPoses()
        self._n_updates = 0
        self._used: set[int] = set()
        self._recent: deque[set[int]] = deque(maxlen=_RECENT)
        self._not_in_use = gtsam.KeyList()
        self._listed: set[int] = set()  # in that list, which cannot be read
        self._ask_shared: Callable[[], SharedUnknown | None] = lambda: None
        self._forget()

    def _forget(self) -> None:
        """The graph has changed: what was read out of it before holds no more."""
        self._whole: gtsam.Values | None = None
        self._poses: dict[int, FloatArray] = {}
        self._table: tuple[np.ndarray, FloatArray] | None = None  # keys of all poses, ascending, and all poses
        self._planes: dict[int, gtsam.OrientedPlane3] = {}
        self._delta: gtsam.VectorValues | None = None
        self._joint: JointCovariance | None = None
        self._known_shared: SharedUnknown | None = None

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
        factors = self._isam.getFactorsUnsafe()
        return _graph_of(factors.at(index) for index in range(factors.size()) if factors.exists(index))

    @timed("optimise")
    def update(
        self, factors: Iterable[Any], initial: gtsam.Values, remove: Sequence[int] = (), *, relinearize: bool = False
    ) -> list[int]:
        """Add factors and variables, remove factors by index; returns the indices of the new factors.

        Of what has moved the variables in use, those of these factors and of the ones before, are relinearised first:
        gates are drawn and estimates made by them. The others, which a correction moves a little all along the way, are
        every so often, and where `relinearize` asks for it, once more after.

        Raises:
            BackendError: the system became indeterminate.
        """
        given = list(factors)
        used = {key for factor in given for key in list(factor.keys())}
        held = None if relinearize else self._out_of_use(used)
        indices, _ = self._step(_graph_of(given), initial, list(remove), self._eliminated_last(used), held)
        if relinearize:
            self._step()
        return indices

    def _eliminated_last(self, keys: Iterable[int]) -> gtsam.KeyGroupMap:
        """These and the recent variables: the tree begins with what is eliminated last, and to ask there is cheap.

        What iSAM2 is not told it eliminates early. Of the last two poses of 600 a joint covariance took 11 ms, a path
        through the tree, and takes 0.4 ms.
        """
        now, groups = set(keys), gtsam.KeyGroupMap()
        self._recent.append(now)
        for key in sorted(set().union(*self._recent)):
            if key in now or self._isam.valueExists(key):
                groups.insert2(key, 1)
        return groups

    def _bring_up(self, keys: Sequence[int]) -> None:
        """Put variables where the tree begins: they are asked about, and mostly seen next."""
        below = set(keys).difference(*self._recent)
        if not below or len(keys) > _MANY:
            return
        last, others = self._eliminated_last(keys), self._all_but(set())
        self._step(*_NOTHING, last, others, _key_list(below))

    def _out_of_use(self, used: set[int]) -> gtsam.KeyList | None:
        """Keys of the variables that need not be relinearised when factors of some are added; None: all may be."""
        in_use, self._used = used | self._used, used
        self._n_updates += 1
        return None if self._n_updates % _ALL_EVERY == 0 else self._all_but(in_use)

    def _all_but(self, in_use: set[int]) -> gtsam.KeyList:
        """The keys of all other variables: a list kept up to date, for a new one takes as long as a marginal."""
        wanted = set(self._isam.getLinearizationPoint().keys()) - in_use
        for key in self._listed - wanted:
            self._not_in_use.remove(key)
        for key in wanted - self._listed:
            self._not_in_use.push_back(key)
        self._listed = wanted
        return self._not_in_use

    @timed("optimise")
    def relinearize_in_use(self) -> None:
        """Once more at the estimate what the last factors are of, and nothing else."""
        self._step(*_NOTHING, None, self._all_but(self._used))

    @timed("optimise")
    def exchange(self, factors: Iterable[Any], remove: Sequence[int], leaving: Iterable[int]) -> list[int]:
        """Put factors in the place of many others, with which variables leave; returns the indices of the new ones.

        Everything is eliminated anew in an order that suits the new graph. By itself iSAM2 puts the variables that
        changed last: where the ends of a long loop became one (470 factors of 6097) that took 1.03 s, this 0.15 s.

        Raises:
            BackendError: the system became indeterminate.
        """
        staying = _key_list(set(self._isam.getLinearizationPoint().keys()).difference(leaving))
        return self._step(_graph_of(factors), gtsam.Values(), list(remove), None, None, staying)[0]

    @timed("optimise")
    def settle(self, rounds: int) -> None:
        """Relinearise a few times over, until nothing moves: after something that moved the estimate far."""
        for _ in range(rounds):
            if not self._step()[1]:
                break

    @timed("optimise")
    def settles_below(self, chi2: float, rounds: int) -> bool:
        """Relinearise as `settle` does; whether the chi2 of the graph comes below a limit.

        From the second round on it is given up where those that are left, each as good as the last, would not do.
        """
        now = self.chi2()
        for number in range(rounds):
            _, relinearized = self._step()
            before, now = now, self.chi2()
            hopeless = now - (rounds - 1 - number) * max(before - now, 0.0) > chi2
            if not relinearized or (number and hopeless):
                break
        return now <= chi2

    def _step(self, *arguments: Any) -> tuple[list[int], int]:
        """One update: the indices of the factors that are new, and how many variables were relinearised."""
        n_before = self._isam.getFactorsUnsafe().size()
        try:
            result = self._isam.update(*arguments)
            return list(result.getNewFactorsIndices()), result.getVariablesRelinearized()
        except RuntimeError as error:
            self._isam = self._by_qr(error)
            n_now = self._isam.getFactorsUnsafe().size()
            return list(range(n_before, n_now)), self._isam.getLinearizationPoint().size()
        finally:
            self._forget()

    def _by_qr(self, failure: RuntimeError) -> gtsam.ISAM2:
        """The same factors under the same indices, linearised where they are, eliminated by QR after a failure.

        Of an update whose elimination failed iSAM2 has all but the tree.
        """
        if INDETERMINATE not in str(failure):
            raise BackendError(_first_line(failure)) from failure
        factors, twin = self._isam.getFactorsUnsafe(), self._empty("QR")
        values, used = gtsam.Values(self._isam.getLinearizationPoint()), set(factors.keyVector())
        for key in set(values.keys()) - used:  # of what leaves with its last factor
            values.erase(key)
        try:
            twin.update(factors, values)
        except RuntimeError as error:
            raise BackendError(_first_line(error)) from error
        return twin

    def _empty(self, factorization: str) -> gtsam.ISAM2:
        parameters = isam2_parameters()
        parameters.setFactorization(factorization)
        parameters.setRelinearizeThreshold(self._thresholds)
        return gtsam.ISAM2(parameters)

    def snapshot(self) -> gtsam.ISAM2:
        """The graph and its estimate as they are, for `restore`."""
        return gtsam.ISAM2(self._isam)

    def restore(self, snapshot: gtsam.ISAM2) -> None:
        """Go back to a snapshot, as if nothing had been done since, bit for bit; it is used up. Poses did not leave."""
        self._isam = snapshot
        self._forget()

    def chi2(self) -> float:
        """Sum of the squared whitened errors of all factors at the current estimate."""
        return 2.0 * float(self._isam.getFactorsUnsafe().error(self.values))

    def pose(self, key: int) -> FloatArray:
        """world_T_body of a pose variable, shape (4, 4)."""
        if key not in self._poses:
            held = self.holds(key)
            self._poses[key] = (
                self._isam.calculateEstimatePose3(key).matrix() if held else self._past.pose(key, self.pose)
            )
        return self._poses[key]

    def poses(self, keys: Sequence[int] | np.ndarray) -> FloatArray:
        """world_T_body of many pose variables, shape (N, 4, 4)."""
        if self._table is None:
            here = np.array(list(self.values.keys()), dtype=np.int64)
            here = here[np.isin(here >> 56, list(_POSE_CODES))]
            rows, poses = gtsam.utilities.extractPose3(self.values), np.tile(np.eye(4), (len(here), 1, 1))
            poses[:, :3, :3], poses[:, :3, 3] = rows[:, :9].reshape(-1, 3, 3), rows[:, 9:]
            self._table = here, poses
        here, poses = self._table
        wanted = np.asarray(keys, dtype=np.int64)
        rows = np.searchsorted(here, wanted)
        found = poses.take(rows, axis=0, mode="clip")
        for index in np.flatnonzero(here.take(rows, mode="clip") != wanted).tolist():
            found[index] = self.pose(int(wanted[index]))  # it has left the graph
        return found

    def holds(self, key: int) -> bool:
        """Whether a pose is a variable of the graph; if not, it has left it."""
        return key not in self._past

    def rigid_base(self, key: int) -> tuple[int, FloatArray]:
        """The pose in the graph that a pose moves with, itself where it is there, and where it is from it, (4, 4)."""
        carrier_T_pose = np.eye(4)
        while not self.holds(key):
            past = self._past.at(key)
            key, carrier_T_pose = past.base_key, past.base_T_pose @ carrier_T_pose
        return key, carrier_T_pose

    @property
    def n_left(self) -> int:
        """How many poses have left the graph."""
        return len(self._past)

    def marginalize(self, bases: dict[int, int]) -> None:
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
            self._bring_up(keys)
            self._joint = self._joint_of(keys)
        return self._joint

    @timed("marginals")
    def read_joint_covariance(self, keys: Sequence[int], *, shared: bool = True) -> JointCovariance:
        """The same for who looks at the map: bits do not depend on who asked what before.

        With the uncertainty of what factors share that is no variable of the graph, unless it is asked without.
        """
        joint = self._joint_of(keys)
        if shared and self._known_shared is None:
            self._known_shared = self._ask_shared()
        unknown = self._known_shared if shared else None
        return joint if unknown is None else joint.plus(np.vstack([unknown.effect_on(key) for key in keys]))

    def share(self, unknown: Callable[[], SharedUnknown | None]) -> None:
        """Let covariances that are read hold that of an unknown that factors share; it is asked for when they are."""
        self._ask_shared = unknown

    @timed("optimise")
    def with_shared(self, key: int, instead: Mapping[int, gtsam.GaussianFactor]) -> SharedUnknown:
        """The graph at its estimate with one more variable, known to linear factors that stand for some of its own.

        Args:
            key: of the variable.
            instead: those factors, by the indices of the ones they stand for, linearised at `values`.

        Raises:
            BackendError: the system became indeterminate.
        """
        ours, values, linear = self._isam.getFactorsUnsafe(), self.values, gtsam.GaussianFactorGraph()
        for index in range(ours.size()):
            if ours.at(index) is not None:
                linear.push_back(instead[index] if index in instead else ours.at(index).linearize(values))
        try:
            return SharedUnknown.of(key, linear)
        except RuntimeError as error:
            raise BackendError(_first_line(error)) from error

    def _joint_of(self, keys: Sequence[int]) -> JointCovariance:
        return JointCovariance(keys, self._marginal(keys), [self._to_estimate(key) for key in keys])

    def _marginal(self, keys: Sequence[int]) -> FloatArray:
        """Joint marginal covariance of some variables at the linearisation point of the tree.

        Of many of them by eliminating all others from the graph: what the tree takes grows with more than their cube
        (373 of 402: 13.5 s by the tree, 0.16 s by the graph, the same to 2e-8 of the standard deviations).
        """
        if len(keys) > _MANY:
            covariance = _inverse_of_information(self.graph.linearize(self._isam.getLinearizationPoint()), keys)
            if covariance is not None:
                return covariance
        try:
            return self._isam.jointMarginalCovariance(list(keys)).fullMatrix()
        except RuntimeError as error:
            twin = self._by_qr(error)
        try:
            return twin.jointMarginalCovariance(list(keys)).fullMatrix()
        except RuntimeError as error:
            raise BackendError(_first_line(error)) from error

    @timed("marginals")
    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance of one variable in its GTSAM tangent order, in the tangent of its current estimate."""
        if key in self._past:
            return self._past.covariance(key, self.covariance)
        if self._joint is not None and self._joint.has([key]):
            return self._joint.of([key])
        return self._joint_of([key]).of([key])

    def read_covariance(self, key: int) -> FloatArray:
        """The same for who looks at the map, with the uncertainty of what factors share."""
        if key in self._past:
            return self._past.covariance(key, self.read_covariance)
        return self.read_joint_covariance([key]).full

    def _to_estimate(self, key: int) -> FloatArray:
        """Matrix that takes a tangent at iSAM2's linearisation point to one at the estimate.

        For a plane the two differ by more than second order: ``Unit3.basis()`` jumps where components of the normal
        tie, so at every floor and every axis-aligned wall the two tangents may be turned by 90 deg. iSAM2's marginals
        are those of its linearisation point.
        """
        if _is_pose(key):
            return STAYS
        matrix = np.eye(3)
        here, there = self.plane(key), self._isam.getLinearizationPoint().atOrientedPlane3(key)
        matrix[:2, :2] = here.normal().basis().T @ there.normal().basis()
        return matrix

    def optimize_batch(self) -> gtsam.Values:
        """Levenberg-Marquardt on the same factors, started from the current estimate."""
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        return gtsam.LevenbergMarquardtOptimizer(self.graph, self.values, parameters).optimize()

    @timed("optimise")
    def rebuild(self, values: gtsam.Values) -> None:
        """Start anew from other values with the same factors, under the same indices."""
        old = self._isam
        self._isam = self._empty("CHOLESKY")
        self._step(old.getFactorsUnsafe(), values)


def _key_list(keys: Iterable[int]) -> gtsam.KeyList:
    ascending = gtsam.KeyList()
    for key in sorted(keys):
        ascending.push_back(key)
    return ascending


def _graph_of(factors: Iterable[Any]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.push_back(factor)
    return graph


def _inverse_of_information(linear: gtsam.GaussianFactorGraph, keys: Sequence[int]) -> FloatArray | None:
    """Joint covariance of some variables of a linear graph; None: the information is not positive to rounding."""
    try:
        information, _ = linear.marginal(list(keys)).hessian(gtsam.Ordering(list(keys)))
        scale = 1.0 / np.sqrt(np.diag(information))
        information *= scale
        information *= scale[:, None]
        factor, _ = cho_factor(information, lower=True, overwrite_a=True)
    except (RuntimeError, ValueError):  # a LinAlgError is a ValueError
        return None
    # in place: of 200 planes and their anchors it is 26 MB
    covariance, _ = _invert_factored(factor, lower=True, overwrite_c=True)
    for row in range(1, len(covariance)):
        covariance[:row, row] = covariance[row, :row]
    covariance *= scale
    covariance *= scale[:, None]
    return covariance


def pose_symbol(index: int) -> int:
    """GTSAM key of the pose of a keyframe."""
    return gtsam.symbol("x", index)


def pose_symbols(indices: Sequence[int]) -> np.ndarray:
    """Of many keyframes, shape (N,): a key has the index in its lower part."""
    return pose_symbol(0) + np.asarray(indices, dtype=np.int64)


def _thresholds(config: BackendConfig) -> gtsam.ISAM2ThresholdMap:
    """Changes of poses (of the body, and of a prior map) and of planes (tilt, distance) that relinearise them.

    Planes that are parallel, or level, fix nothing along them. Linearised at normals that are off, they do: a floor off
    by 4 mrad, its height measured to 0.2 mm from every keyframe, says to 5 cm where the body is, each time.
    """
    thresholds, change = gtsam.ISAM2ThresholdMap(), config.relinearize_threshold
    for letter in _POSES:
        thresholds.insert((letter, np.full(6, change)))
    tilt = min(config.relinearize_tilt_rad, change)
    thresholds.insert(("p", np.array((tilt, tilt, change))))
    return thresholds


def _is_pose(key: int) -> bool:
    return key >> 56 in _POSE_CODES


def _first_line(error: Exception) -> str:
    return " ".join(str(error).split("\n\n")[0].split())
