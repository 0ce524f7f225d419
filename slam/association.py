"""Which landmark is it: chi2 with measurement and state covariance, the side, and where it was seen."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from math import log, pi
from typing import Literal

import gtsam
import numpy as np
from scipy.special import chdtrc

from slam.backend import Backend, JointCovariance
from slam.config import AssociationConfig
from slam.frames import inverse
from slam.landmarks import Landmark, LandmarkMap, PlacedPlane, observe
from slam.observations import Observation
from slam.odometry import Motion
from spplanes._check import FloatArray

#: Bounds drawn from a standard deviation are taken at this many of them.
_SIGMAS = 3.0
_LOG_2PI = log(2.0 * pi)


@dataclass(frozen=True)
class Candidate:
    """A landmark that an observation was compared with."""

    landmark: int
    """Its id."""
    chi2: float
    """Squared Mahalanobis distance between measured and predicted plane, with state and measurement covariance."""
    dof: int
    """Degrees of freedom: 3 for a plane, 2 for a line."""
    log_likelihood: float
    """Log density of the measurement under this landmark, per rad (of a plane: rad^2) and m."""
    confirmed: bool
    """Whether more than one keyframe has seen the landmark."""

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 if it is the same plane."""
        return float(chdtrc(self.dof, max(self.chi2, 0.0)))


@dataclass(frozen=True)
class Decision:
    """What became of one observation, and why."""

    observation: int
    """Index of the observation in its keyframe."""
    verdict: Literal["match", "new", "unsure"]
    """match: one plane with a landmark; new: none of them; unsure: neither can be said, so it is not used."""
    match: Candidate | None
    """The accepted candidate of a match."""
    candidates: tuple[Candidate, ...]
    """All landmarks it was compared with, most likely first; a confirmed one that passes goes before the others."""


def associate(
    observations: Sequence[Observation],
    pose_key: int,
    landmarks: LandmarkMap,
    backend: Backend,
    config: AssociationConfig,
    hint: Hint | None = None,
    *,
    among: Collection[int] | None = None,
) -> list[Decision]:
    """Decide for every observation of a keyframe whose pose is already predicted in the graph.

    The chi2 is the factor's own: with A, b its whitened linearisation and P the joint marginal covariance of pose,
    anchors and landmarks, chi2 = r^T (A P A^T + I)^-1 r, r = b - A m. So the gate tests exactly what the graph will be
    told. The firmest observation is decided first, and mean m and covariance P are conditioned on every match before
    the next is judged: what is accepted is jointly compatible, and each chi2 is an innovation of its own. What could be
    two landmarks, a wall or the notice-board on it, waits until all that is clear has been taken in.

    With a `hint`, such as all returns give, the decisions are made by a state that knows it; the chi2 they are gated by
    and report is that of the state without it, for the hint is made of the same returns as the lines.

    Only the landmarks `among` are looked at when it is given.

    Returns:
        One decision for each observation, in their order.
    """
    world_T_body = backend.pose(pose_key)
    spread = Spread.of(backend.covariance(pose_key))
    shortlists = [_shortlist(observation, landmarks, world_T_body, spread, config) for observation in observations]
    chances = [
        _log_density(observation, len(shortlist), spread, config)
        for observation, shortlist in zip(observations, shortlists, strict=True)
    ]
    if among is not None:
        shortlists = [[landmark for landmark in shortlist if landmark.id in among] for shortlist in shortlists]
    keys = {pose_key} if hint is None else {pose_key, hint.key}
    for landmark in (landmark for shortlist in shortlists for landmark in shortlist):
        keys.update((landmark.key, landmark.anchor_key))
    ordered = sorted(keys)
    joint, values = backend.joint_covariance(ordered), backend.values_of(ordered)  # once is cheaper than for each pair
    state, honest = _State(joint), None if hint is None else _State(joint)
    if hint is not None:
        state.take(hint, pose_key, values)
    prospects = [
        _prospects(observation, shortlist, pose_key, joint, values, backend)
        for observation, shortlist in zip(observations, shortlists, strict=True)
    ]
    decisions: dict[int, Decision] = {}
    firmest_first = sorted(range(len(observations)), key=lambda i: (-observations[i].n_points, i))
    for waits in (_is_open, lambda decision, config: False):
        for index in [index for index in firmest_first if index not in decisions]:
            innovations = _innovations(prospects[index], state)
            decision = _decide(index, [innovation.candidate for innovation in innovations], chances[index], config)
            if waits(decision, config):
                continue
            if decision.match is not None:
                chosen = next(i for i in innovations if i.candidate is decision.match)
                if honest is not None:
                    decision = _audited(decision, chosen, honest, config)
                if decision.match is not None:
                    state.condition(chosen)
            decisions[index] = decision
    return [decisions[index] for index in range(len(observations))]


@dataclass(frozen=True, eq=False)
class Hint:
    """What else is known of a keyframe's pose while its observations are being told apart."""

    key: int
    """Key of another pose."""
    motion: Motion
    """The motion from there."""


def _audited(decision: Decision, chosen: _Innovation, honest: _State, config: AssociationConfig) -> Decision:
    """The decision with the chi2 of the state that has no hint; unsure where that state refuses it."""
    innovation = honest.innovation(chosen.prospect)
    if innovation.candidate.p_value < config.significance:
        return replace(decision, verdict="unsure", match=None)
    honest.condition(innovation)
    return replace(decision, match=innovation.candidate)


@dataclass(frozen=True)
class Spread:
    """How far a pose may be from its estimate."""

    position_m: float
    """Largest standard deviation of the position over all directions, m."""
    angle_rad: float
    """Largest standard deviation of the orientation over all axes, rad."""

    @classmethod
    def of(cls, covariance: FloatArray) -> Spread:
        """From the (6, 6) marginal covariance of a Pose3, tangent order (rotation, translation)."""
        return cls(
            position_m=float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0))),
            angle_rad=float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))),
        )


def _bounds(observation: Observation, spread: Spread, config: AssociationConfig) -> tuple[float, float]:
    """How far (m) and how much turned (rad) a landmark may lie from where the observation puts it."""
    reach = float(np.linalg.norm(observation.vertices, axis=1).max())
    margin = config.gap_m + _SIGMAS * (spread.position_m + reach * spread.angle_rad)
    return margin, config.max_angle_rad + _SIGMAS * spread.angle_rad


def _log_density(observation: Observation, n_near: int, spread: Spread, config: AssociationConfig) -> float:
    """Log of how many other planes there are about an observation, per rad (of a plane: rad^2) and m.

    As many, and one, lie within the bounds as landmarks do: a place with many walls has more that are not known yet.
    """
    margin, angle = _bounds(observation, spread, config)
    turns = 1 if observation.kind == "line" else 2
    volume = 2.0 * margin * (2.0 * min(angle, 0.5 * np.pi)) ** turns
    return float(np.log(config.chance_factor * (n_near + 1) / volume))


def _shortlist(
    observation: Observation,
    landmarks: LandmarkMap,
    world_T_body: FloatArray,
    spread: Spread,
    config: AssociationConfig,
) -> list[Landmark]:
    """Landmarks that the observation is compared with: those near by their bounds, then by their outlines."""
    vertices = observation.vertices
    middle = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    radius = float(np.linalg.norm(vertices - middle, axis=1).max())
    margin, angle = _bounds(observation, spread, config)
    normal = world_T_body[:3, :3] @ observation.normal
    near = landmarks.near(normal, world_T_body[:3, :3] @ middle + world_T_body[:3, 3], radius + margin, angle)
    return [
        landmark
        for landmark, placed in near
        if _is_plausible(observation, landmark, placed, world_T_body, margin, angle)
    ]


def _is_plausible(
    observation: Observation,
    landmark: Landmark,
    placed: PlacedPlane,
    world_T_body: FloatArray,
    margin: float,
    angle: float,
) -> bool:
    """Same side, similar direction, and near enough: bounds so wide that the chi2 test decides, not they."""
    plane_T_body = inverse(placed.world_T_plane) @ world_T_body
    if float(plane_T_body[2, :3] @ observation.normal) < np.cos(min(angle, 0.5 * np.pi)):
        return False
    heights = observation.vertices @ plane_T_body[2, :3] + plane_T_body[2, 3]
    if np.abs(heights).min() > margin:
        return False
    return landmark.region.is_within(margin, observation.patch_in(plane_T_body))


@dataclass(frozen=True, eq=False)
class _Prospect:
    """A linearised factor of an observation under the assumption that it is a certain landmark."""

    candidate: Candidate
    """Its log likelihood is that of no error and no spread yet."""
    columns: np.ndarray
    jacobian: FloatArray
    target: FloatArray


@dataclass(frozen=True, eq=False)
class _Innovation:
    """A prospect compared with a state."""

    candidate: Candidate
    prospect: _Prospect
    residual: FloatArray
    covariance: FloatArray


class _State:
    """Mean and covariance of the tangents of all variables that a keyframe may touch."""

    def __init__(self, joint: JointCovariance) -> None:
        self._joint = joint
        self._covariance = joint.full.copy()
        self._mean = np.zeros(len(self._covariance))

    def innovation(self, prospect: _Prospect) -> _Innovation:
        """Compare a prospect with the state: chi2 and likelihood."""
        columns, jacobian = prospect.columns, prospect.jacobian
        residual = prospect.target - jacobian @ self._mean[columns]
        covariance = jacobian @ self._covariance[columns[:, None], columns] @ jacobian.T + np.eye(len(residual))
        chi2, log_det = _chi2_and_log_det(residual.tolist(), covariance.tolist())
        blank = prospect.candidate
        log_likelihood = blank.log_likelihood - 0.5 * (chi2 + log_det)
        candidate = Candidate(blank.landmark, chi2, blank.dof, log_likelihood, blank.confirmed)
        return _Innovation(candidate, prospect, residual, covariance)

    def take(self, hint: Hint, pose_key: int, values: gtsam.Values) -> None:
        """Take in what is known of the pose beside the observations."""
        linear = hint.motion.factors(hint.key, pose_key)[0].linearize(values)
        jacobian, target = linear.jacobian()
        columns = self._joint.columns(list(linear.keys()))
        blank = Candidate(-1, 0.0, len(target), 0.0, False)
        self.condition(self.innovation(_Prospect(blank, columns, jacobian, target)))

    def condition(self, innovation: _Innovation) -> None:
        """Take an innovation in: the Kalman update."""
        spread = self._covariance[:, innovation.prospect.columns] @ innovation.prospect.jacobian.T
        gain = np.linalg.solve(innovation.covariance, spread.T).T
        self._mean = self._mean + gain @ innovation.residual
        self._covariance = self._covariance - gain @ spread.T


def _chi2_and_log_det(residual: list[float], covariance: list[list[float]]) -> tuple[float, float]:
    """r^T C^-1 r and the log of det(2 pi C) of a symmetric C that is at least the identity: by L D L^T, in scalars."""
    chi2, log_det = 0.0, len(residual) * _LOG_2PI
    for i in range(len(residual)):
        pivot, row = covariance[i][i], covariance[i]
        chi2 += residual[i] ** 2 / pivot
        log_det += log(abs(pivot))
        for j in range(i + 1, len(residual)):
            share = row[j] / pivot
            residual[j] -= share * residual[i]
            covariance[j] = [one - share * other for one, other in zip(covariance[j], row, strict=True)]
    return chi2, log_det


def _prospects(
    observation: Observation,
    shortlist: Sequence[Landmark],
    pose_key: int,
    joint: JointCovariance,
    values: gtsam.Values,
    backend: Backend,
) -> list[_Prospect]:
    """The observation's factor for each landmark of its shortlist, linearised at the estimate."""
    blank, prospects = -float(np.log(observation.volume)) if shortlist else 0.0, []
    for landmark in shortlist:
        linear = observe(observation, pose_key, landmark, backend).linearize(values)
        jacobian, target = linear.jacobian()
        telling = np.abs(jacobian).max(axis=1) > 0.0  # a native line factor has an empty row: two dof, not three
        candidate = Candidate(landmark.id, 0.0, int(telling.sum()), blank, landmark.n_keyframes > 1)
        prospects.append(_Prospect(candidate, joint.columns(list(linear.keys())), jacobian[telling], target[telling]))
    return prospects


def _innovations(prospects: Sequence[_Prospect], state: _State) -> list[_Innovation]:
    """The observation under each of its candidates, most likely first; equals in order of their birth."""
    found = [state.innovation(prospect) for prospect in prospects]
    return sorted(found, key=lambda one: (-one.candidate.log_likelihood, one.candidate.landmark))


def _decide(index: int, candidates: list[Candidate], chance: float, config: AssociationConfig) -> Decision:
    """The decision by the candidates alone; `chance` is the log density of other planes about the observation."""
    accepted = [
        candidate
        for candidate in candidates
        if candidate.p_value >= config.significance and candidate.log_likelihood >= chance
    ]
    if accepted:
        # a landmark that one look made may be a bad copy of a known one: it must not take the known one's measurements
        best = next((candidate for candidate in accepted if candidate.confirmed), accepted[0])
        return Decision(index, "match", best, tuple(candidates))
    near = any(candidate.p_value >= config.new_significance for candidate in candidates)
    return Decision(index, "unsure" if near else "new", None, tuple(candidates))


def _is_open(decision: Decision, config: AssociationConfig) -> bool:
    """Whether more knowledge of the pose could change the decision: unsure, or a match that has a rival."""
    if decision.match is None:
        return decision.verdict == "unsure"
    least = decision.match.log_likelihood - config.rival_log_ratio
    return any(
        candidate is not decision.match
        and candidate.p_value >= config.significance
        and candidate.log_likelihood >= least
        for candidate in decision.candidates
    )
