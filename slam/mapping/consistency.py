"""Consistency: the NIS of every accepted observation against what chi2 should be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from scipy.special import gammaincinv

from factors.association.gating import elsewhere, hypotheses_of
from factors.association.observations import Observation
from slam.backend.estimator import Backend
from slam.lazy import Rows
from slam.map.data_association import Decision
from slam.map.landmarks import LandmarkMap
from slam.tracking.prediction import Prediction
from spplanes._check import FloatArray


@dataclass
class NisAudit:
    """Normalised innovation squared, summed by factor type.

    Innovations are taken before the update, with state and measurement covariance, so their sum over a run is chi2
    with the summed degrees of freedom when every covariance is honest. The gate cuts the upper tail off, which moves
    the mean down by less than its significance. Of a keyframe without odometry the pose is taken as unknown: what its
    planes say beyond finding it is an innovation (`innovations_without_prediction`).
    """

    history: dict[str, Rows] = field(default_factory=dict)
    """(keyframe, chi2, dof) of every accepted measurement, by factor type."""

    _sums: tuple[float, int] = (0.0, 0)

    def add(
        self,
        seen: Sequence[Observation],
        prediction: Prediction,
        decisions: Sequence[Decision],
        landmarks: LandmarkMap,
        backend: Backend,
    ) -> None:
        """Hold what was matched against what was known, of which the graph does not know yet.

        Where what was seen is what said where to look, there is nothing to hold; a measurement without a degree of
        freedom says nothing.
        """
        matches = [(one.observation, one.match.landmark) for one in decisions if one.match is not None]
        if prediction.hints or not matches:
            return
        if prediction.planes_asked:
            matches.sort(key=lambda pair: (-seen[pair[0]].n_points, pair[0]))  # each has what it adds to firmer ones
        linear = _Linearised(seen, matches, prediction.pose_key, landmarks, backend)
        ask = innovations_without_prediction if prediction.planes_asked else innovations
        for (number, _), (chi2, dof) in zip(matches, ask(linear), strict=True):
            if dof:
                self.history.setdefault(seen[number].kind, Rows("idh")).append((prediction.index, chi2, dof))
                self._sums = self._sums[0] + chi2, self._sums[1] + dof

    def summary(self) -> list[NisSummary]:
        """Mean NIS per degree of freedom and its band, one row a factor type, in alphabetical order."""
        return [NisSummary.of(kind, self.history[kind]) for kind in sorted(self.history)]

    @property
    def mean_per_dof(self) -> float:
        """Mean NIS per degree of freedom of all factor types together; 1 without any."""
        return self._sums[0] / self._sums[1] if self._sums[1] else 1.0

    def warnings(self) -> list[str]:
        """One sentence for every factor type whose covariances claim too much."""
        return [
            f"the {row.kind} factors are over-confident: mean NIS per degree of freedom {row.mean_per_dof:.2f}, "
            f"above its 95 % band up to {row.high:.2f}; state more noise in the rig"
            for row in self.summary()
            if row.verdict == "over-confident"
        ]


@dataclass(frozen=True)
class NisSummary:
    """Mean NIS of one factor type against its chi2 band."""

    kind: str
    """Factor type."""
    count: int
    """Number of measurements."""
    mean_per_dof: float
    """Sum of chi2 over sum of degrees of freedom: 1 when covariances are honest."""
    low: float
    """Lower end of the 95 % band of that mean."""
    high: float
    """Upper end of the 95 % band of that mean."""

    @property
    def verdict(self) -> str:
        """over-confident, cautious or consistent."""
        if self.mean_per_dof > self.high:
            return "over-confident"
        return "cautious" if self.mean_per_dof < self.low else "consistent"

    @classmethod
    def of(cls, kind: str, history: Sequence[tuple[int, float, int]]) -> NisSummary:
        """Summarise the measurements of one type."""
        total = float(np.sum([chi2 for _, chi2, _ in history]))
        dof = int(np.sum([dof for _, _, dof in history]))
        low, high = 2.0 * gammaincinv(0.5 * dof, [(1 - 0.95) / 2, (1 + 0.95) / 2]) / dof
        return cls(kind, len(history), total / dof, float(low), float(high))


class _Linearised:
    """The factors of matches (observation, landmark) from a pose, and the state that they are held against.

    To be asked before the factors of the pose's keyframe are in the graph.
    """

    def __init__(
        self,
        observations: Sequence[Observation],
        matches: Sequence[tuple[int, int]],
        pose_key: int,
        landmarks: LandmarkMap,
        backend: Backend,
    ) -> None:
        self._matches = [(observations[index], landmarks[landmark]) for index, landmark in matches]
        keys = sorted({pose_key, *(key for _, one in self._matches for key in (one.key, one.anchor_key))})
        self._joint, self._values = backend.joint_covariance(keys), backend.values_of(keys)
        self._pose_key, self._backend = pose_key, backend
        self.covariance, self.of_pose = self._joint.full, self._joint.columns([pose_key])

    def at(self, change: FloatArray | None = None) -> tuple[FloatArray, FloatArray, list[int]]:
        """Where the pose is elsewhere than the estimate has it, by that tangent (6,); None: nowhere.

        Returns:
            Whitened Jacobian (K, D) and residual (K,) of all, and where the rows of each end, from 0 on.
        """
        rows, residuals, values = [], [], elsewhere(self._values, self._pose_key, change)
        for observation, landmark in self._matches:
            [one] = hypotheses_of(observation, [landmark], self._pose_key, self._joint, values, self._backend, change)
            rows.append(np.zeros((len(one.target), len(self.covariance))))
            rows[-1][:, one.columns] = one.jacobian
            residuals.append(one.target)
        return np.vstack(rows), np.concatenate(residuals), np.cumsum([0, *map(len, residuals)]).tolist()


def innovations(linear: _Linearised) -> list[tuple[float, int]]:
    """Chi2 and degrees of freedom of every match, each beyond those before it.

    A long wall tells a heading a thousand times better than wheels do: what is neglected of that innovation by a
    linearisation before it is many sigmas of the next wall. So they are linearised again where the first update leads,
    as in an iterated filter.

    References:
        Bell, Cathey, "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans. Autom. Control 1993.
    """
    jacobian, residual, _ = linear.at()
    spread = linear.covariance @ jacobian.T
    change = spread[linear.of_pose] @ np.linalg.solve(jacobian @ spread + np.eye(len(residual)), residual)
    jacobian, residual, ends = linear.at(change)
    root = np.linalg.cholesky(jacobian @ linear.covariance @ jacobian.T + np.eye(len(residual)))
    parts = np.split(np.linalg.solve(root, residual), ends[1:-1])
    return [(float(part @ part), len(part)) for part in parts]


def innovations_without_prediction(linear: _Linearised) -> list[tuple[float, int]]:
    """Chi2 and degrees of freedom of every match, each beyond those before it, without what was known of the pose.

    Where no odometry is, the pose of a keyframe is found by its planes: a prediction made of them agrees with them, and
    a wide one with anything. So the pose is taken as unknown. What the matches say beyond finding it has to agree
    within the covariance of measurements and map, which is chi2 with six degrees of freedom less where they fix
    everything.
    """
    jacobian, residual, ends = linear.at()
    by_map, by_pose = jacobian.copy(), jacobian[:, linear.of_pose]
    by_map[:, linear.of_pose] = 0.0
    root = np.linalg.cholesky(by_map @ linear.covariance @ by_map.T + np.eye(len(residual)))
    # in units of what measurements and map let them be; a row depends on no residual after its own
    whitened = np.asarray(np.linalg.solve(root, np.column_stack((residual, by_pose))), float)
    left = [_left_over(whitened[:end, 0], whitened[:end, 1:]) for end in ends]
    return [(max(chi2 - before, 0.0), dof - used) for (before, used), (chi2, dof) in pairwise(left)]


def _left_over(residual: FloatArray, by_pose: FloatArray) -> tuple[float, int]:
    """What no pose explains of whitened residuals (n,) that depend on it by (n, 6): chi2 and degrees of freedom."""
    axes, sizes, _ = np.linalg.svd(by_pose, full_matrices=False)
    explained = axes[:, sizes > 1e-2].T @ residual  # sigmas of a measurement a metre or radian
    return float(residual @ residual - explained @ explained), len(residual) - len(explained)
