"""The back end: iSAM2's current estimate, its marginals, and the same graph as a batch."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import gtsam
import numpy as np
from scipy.linalg import cho_factor, get_lapack_funcs

from factors.isam import tangent_turn
from slam.backend.elimination import POSE_CODES, BackendError, Elimination, first_line, is_pose
from slam.backend.joint_covariance import STAYS, JointCovariance, SharedUnknown, carried, relative_covariance
from slam.backend.marginalized_poses import PastPose, PastPoses
from slam.config import BackendConfig
from slam.geometry.frames import inverse
from slam.timing import timed
from spplanes._check import FloatArray

#: Of more variables than this a joint covariance is read from the graph.
_MANY = 64
_invert_factored = get_lapack_funcs("potri", dtype=np.float64)


class Backend(Elimination):
    """The graph, and all that is read out of it: estimates, covariances, and where poses are that have left it."""

    def __init__(self, config: BackendConfig) -> None:
        super().__init__(config)
        self._past = PastPoses()
        self._ask_shared: list[Callable[[], SharedUnknown | None]] = []

    def _forget(self) -> None:
        self._whole: gtsam.Values | None = None
        self._poses: dict[int, FloatArray] = {}
        self._table: tuple[np.ndarray, FloatArray] | None = None  # keys of all poses, ascending, and all poses
        self._planes: dict[int, gtsam.OrientedPlane3] = {}
        self._delta: gtsam.VectorValues | None = None
        self._joint: JointCovariance | None = None
        self._known_shared: list[SharedUnknown] | None = None

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
            some.insert(key, gtsam.Pose3(self.pose(key)) if is_pose(key) else self.plane(key))
        return some

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

    def chi2(self) -> float:
        """Sum of the squared whitened errors of all factors at the current estimate."""
        return 2.0 * float(self._isam.getFactorsUnsafe().error(self.values))

    def pose(self, key: int) -> FloatArray:
        """world_T_body of a pose variable, shape (4, 4)."""
        if key not in self._poses:
            if self.holds(key):
                self._poses[key] = self._isam.calculateEstimatePose3(key).matrix()
            else:
                past = self._past.at(key)
                self._poses[key] = self.pose(past.base_key) @ past.base_T_pose
        return self._poses[key]

    def poses(self, keys: Sequence[int] | np.ndarray) -> FloatArray:
        """world_T_body of many pose variables, shape (N, 4, 4)."""
        if self._table is None:
            here = np.array(list(self.values.keys()), dtype=np.int64)
            here = here[np.isin(here >> 56, POSE_CODES)]
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

    def relative_pose(self, key_a: int, key_b: int, *, read: bool = False) -> tuple[FloatArray, FloatArray]:
        """Pose b in the frame of a, (4, 4), and its covariance, SP order along b's axes, (6, 6).

        Of poses that have left the graph, by those that they move with. `read` as who looks at the map does.
        """
        (base_a, _), (base_b, base_T_b) = self.rigid_base(key_a), self.rigid_base(key_b)
        a_T_b = inverse(self.pose(key_a)) @ self.pose(key_b)
        if base_a == base_b:
            return a_T_b, np.zeros((6, 6))
        keys = [base_a, base_b]
        joint = self.read_joint_covariance(keys) if read else self.joint_covariance(keys)
        between = inverse(self.pose(base_a)) @ self.pose(base_b)
        return a_T_b, carried(relative_covariance(between, joint.of(keys)), base_T_b)

    @property
    def n_left(self) -> int:
        """How many poses have left the graph."""
        return len(self._past)

    def marginalize(self, bases: dict[int, int]) -> None:
        """Remember poses, which are about to leave the graph, each (key) by one that stays (value)."""
        joint = self.joint_covariance(sorted({*bases, *bases.values()}))
        for key, base in bases.items():
            self._past.add(key, PastPose.of(base, self.pose(base), self.pose(key), joint.of([base, key])))

    def has_plane(self, key: int) -> bool:
        """Whether a landmark is a variable of the graph."""
        return self._isam.valueExists(key)

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
            if len(keys) <= _MANY:
                self._bring_up(keys)
            self._joint = self._joint_of(keys)
        return self._joint

    @timed("marginals")
    def read_joint_covariance(self, keys: Sequence[int], *, shared: bool = True) -> JointCovariance:
        """The same for who looks at the map: bits do not depend on who asked what before.

        With the uncertainty of what factors share that is no variable of the graph, unless it is asked without.
        """
        joint = self._joint_of(keys)
        for unknown in self._shared() if shared else ():
            joint = joint.plus(np.vstack([unknown.effect_on(key) for key in keys]))
        return joint

    def share(self, unknown: Callable[[], SharedUnknown | None]) -> None:
        """Let covariances that are read hold that of an unknown that factors share; it is asked for when they are.

        Of several unknowns each is as uncertain as the graph has it where the others are as they are taken to be.
        """
        self._ask_shared.append(unknown)

    def _shared(self) -> list[SharedUnknown]:
        """The unknowns that factors of the graph share, as it is."""
        if self._known_shared is None:
            self._known_shared = [one for one in (ask() for ask in self._ask_shared) if one is not None]
        return self._known_shared

    @timed("optimise")
    def with_shared(self, key: int, instead: Mapping[int, gtsam.GaussianFactor]) -> SharedUnknown:
        """The graph at its estimate with one more variable, known to linear factors that stand for some of its own.

        Args:
            key: of the variable.
            instead: those factors, by the indices of the ones they stand for, linearised at `values`.

        BackendError: the system became indeterminate.
        """
        ours, values, linear = self._isam.getFactorsUnsafe(), self.values, gtsam.GaussianFactorGraph()
        for index in range(ours.size()):
            if ours.at(index) is not None:
                linear.push_back(instead[index] if index in instead else ours.at(index).linearize(values))
        try:
            return SharedUnknown.of(key, linear)
        except RuntimeError as error:
            raise BackendError(first_line(error)) from error

    def _joint_of(self, keys: Sequence[int]) -> JointCovariance:
        """In the tangents of the estimate: those of planes may be turned against iSAM2's, as `tangent_turn` tells."""
        there = self._isam.getLinearizationPoint()
        turns = [STAYS if is_pose(key) else tangent_turn(there.atOrientedPlane3(key), self.plane(key)) for key in keys]
        return JointCovariance(keys, self._marginal(keys), turns)

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
            raise BackendError(first_line(error)) from error

    @timed("marginals")
    def covariance(self, key: int) -> FloatArray:
        """Marginal covariance of one variable in its GTSAM tangent order, in the tangent of its current estimate."""
        if key in self._past:
            past = self._past.at(key)
            return past.covariance(self.covariance(past.base_key))
        if self._joint is not None and self._joint.has([key]):
            return self._joint.of([key])
        return self._joint_of([key]).of([key])

    def read_covariance(self, key: int) -> FloatArray:
        """The same for who looks at the map, with the uncertainty of what factors share."""
        if key in self._past:
            past = self._past.at(key)
            return past.covariance(self.read_covariance(past.base_key))
        return self.read_joint_covariance([key]).full

    def optimize_batch(self) -> gtsam.Values:
        """Levenberg-Marquardt on the same factors, started from the current estimate."""
        parameters = gtsam.LevenbergMarquardtParams()
        parameters.setLinearSolverType("MULTIFRONTAL_QR")
        return gtsam.LevenbergMarquardtOptimizer(self.graph, self.values, parameters).optimize()


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
