"""Data association: which landmark is it? Chi2 of the joint state, the side, and where it was seen."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np

from factors import get_ready
from slam.association.decisions import OUTLINE_GAP_SCALE_M, Candidate, Decision
from slam.association.gating import Hypothesis, State, hypotheses_of
from slam.association.joint_association import JointCompatibility
from slam.backend.estimator import Backend, JointCovariance
from slam.config import BOUND_SIGMAS, AssociationConfig
from slam.frontend.observations import Observation, planes_of
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse
from slam.map.landmarks import Landmark, LandmarkMap, PlacedPlane
from spplanes._check import FloatArray

__all__ = ["Associate", "Candidate", "Decision", "Hint", "PoseUncertainty", "associate"]


class Associate(Protocol):
    """Data association as `PlaneSlam` calls it; `associate` is the one it uses unless it is given another."""

    def __call__(
        self,
        observations: Sequence[Observation],
        pose_key: int,
        landmarks: LandmarkMap,
        backend: Backend,
        config: AssociationConfig,
        hint: Hint | None = None,
        *,
        among: Collection[int] | None = None,
        trusted: Collection[int] | None = None,
    ) -> list[Decision]:
        """One decision for each observation, in their order."""
        ...


def associate(
    observations: Sequence[Observation],
    pose_key: int,
    landmarks: LandmarkMap,
    backend: Backend,
    config: AssociationConfig,
    hint: Hint | None = None,
    *,
    among: Collection[int] | None = None,
    trusted: Collection[int] | None = None,
) -> list[Decision]:
    """Decide for every observation of a keyframe whose pose is already predicted in the graph.

    The chi2 is the factor's own: with A, b its whitened linearisation and P the joint marginal covariance of pose,
    anchors and landmarks, chi2 = r^T (A P A^T + I)^-1 r, r = b - A m. So the gate tests exactly what the graph will be
    told. The firmest observation is decided first, and mean m and covariance P are conditioned on every match before
    the next is judged: what is accepted is jointly compatible, and each chi2 is an innovation of its own. What could be
    two landmarks, a wall or the notice-board on it, waits until all that is clear has been taken in. Where a match
    shuts out others, `JointCompatibility.best` weighs it against them.

    With a `hint`, such as all returns give, the decisions are made by a state that knows it; the chi2 they are gated by
    and report is that of the state without it, for the hint is made of the same returns as the lines.

    Only the landmarks `among` are looked at when it is given, and only for the observations `trusted`.

    Returns:
        One decision for each observation, in their order.
    """
    world_T_body = backend.pose(pose_key)
    uncertainty = PoseUncertainty.of(backend.covariance(pose_key))
    gates = [_Gate.of(observation, uncertainty, config) for observation in observations]
    shortlists = [_shortlist(gate, landmarks, world_T_body) for gate in gates]
    chances = [_log_density(gate, len(shortlist), config) for gate, shortlist in zip(gates, shortlists, strict=True)]
    if trusted is not None:
        shortlists = [shortlist if index in trusted else [] for index, shortlist in enumerate(shortlists)]
    if among is not None:
        shortlists = [[landmark for landmark in shortlist if landmark.id in among] for shortlist in shortlists]
    keys = {pose_key} if hint is None else {pose_key, hint.key}
    for landmark in (landmark for shortlist in shortlists for landmark in shortlist):
        keys.update((landmark.key, landmark.anchor_key))
    ordered = sorted(keys)
    joint, values = backend.joint_covariance(ordered), backend.values_of(ordered)  # once is cheaper than for each pair
    get_ready(planes_of(observations))
    hypotheses = [
        hypotheses_of(observation, shortlist, pose_key, joint, values, backend)
        for observation, shortlist in zip(observations, shortlists, strict=True)
    ]
    joint_compatibility = JointCompatibility(
        hypotheses,
        chances,
        _OutlineGap(observations, landmarks, world_T_body, config.gap_m),
        [observation.n_points for observation in observations],
        state=lambda: _informed(joint, hint, pose_key, values),
        honest=None if hint is None else lambda: State(joint),
        config=config,
    )
    decisions = joint_compatibility.best().decisions
    return [decisions[index] for index in range(len(observations))]


@dataclass(frozen=True, eq=False)
class Hint:
    """What else is known of a keyframe's pose while its observations are being told apart."""

    key: int
    """Key of another pose."""
    motion: Motion
    """The motion from there."""


def _informed(joint: JointCovariance, hint: Hint | None, pose_key: int, values: gtsam.Values) -> State:
    """The state with what is known of the pose beside the observations."""
    state = State(joint)
    if hint is not None:
        linear = hint.motion.factors(hint.key, pose_key)[0].linearize(values)
        jacobian, target = linear.jacobian()
        blank = Candidate(-1, 0.0, len(target), 0.0, False)
        columns = joint.columns(list(linear.keys()))
        state.condition(state.innovation(Hypothesis(blank, columns, jacobian, target)))
    return state


class _OutlineGap:
    """How much less likely, in nats, landmarks are for where observations lie: worked out once, for who has rivals."""

    def __init__(
        self, observations: Sequence[Observation], landmarks: LandmarkMap, world_T_body: FloatArray, gap_m: float
    ) -> None:
        self._observations, self._landmarks, self._gap_m = observations, landmarks, gap_m
        self._world_T_body = world_T_body
        self._known: dict[tuple[int, int], float] = {}

    def __call__(self, index: int, landmark: int) -> float:
        if (index, landmark) not in self._known:
            plane_T_body = inverse(self._landmarks.placed(landmark).world_T_plane) @ self._world_T_body
            patch = self._observations[index].patch_in(plane_T_body)
            gap = self._landmarks[landmark].extent.distance(patch, self._gap_m)
            self._known[index, landmark] = gap / OUTLINE_GAP_SCALE_M
        return self._known[index, landmark]


@dataclass(frozen=True)
class PoseUncertainty:
    """How far a pose may be from its estimate."""

    position_m: float
    """Largest standard deviation of the position over all directions, m."""
    angle_rad: float
    """Largest standard deviation of the orientation over all axes, rad."""

    @classmethod
    def of(cls, covariance: FloatArray) -> PoseUncertainty:
        """From the (6, 6) marginal covariance of a Pose3, tangent order (rotation, translation)."""
        return cls(
            position_m=float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0))),
            angle_rad=float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0))),
        )


@dataclass(frozen=True, eq=False)
class _Gate:
    """The gate of an observation: within which bounds the landmarks lie that it may be of."""

    observation: Observation
    vertices: FloatArray
    """Corners of the seen patch in the body frame, shape (N, 3), m."""
    margin: float
    """How far a landmark may lie from where the observation puts it, m."""
    angle: float
    """How much turned it may be, rad."""

    @classmethod
    def of(cls, observation: Observation, uncertainty: PoseUncertainty, config: AssociationConfig) -> _Gate:
        vertices = observation.vertices
        reach = float(np.linalg.norm(vertices, axis=1).max())
        margin = config.gap_m + BOUND_SIGMAS * (uncertainty.position_m + reach * uncertainty.angle_rad)
        return cls(observation, vertices, margin, config.max_angle_rad + BOUND_SIGMAS * uncertainty.angle_rad)


def _log_density(gate: _Gate, n_near: int, config: AssociationConfig) -> float:
    """Log of how many other planes there are about an observation, per rad (of a plane: rad^2) and m.

    As many, and one, lie within the bounds as landmarks do: a place with many walls has more that are not known yet.
    """
    turns = 1 if gate.observation.kind == "line" else 2
    volume = 2.0 * gate.margin * (2.0 * min(gate.angle, 0.5 * np.pi)) ** turns
    return float(np.log(config.chance_factor * (n_near + 1) / volume))


def _shortlist(gate: _Gate, landmarks: LandmarkMap, world_T_body: FloatArray) -> list[Landmark]:
    """Landmarks that the observation is compared with: those near by their bounds, then by their outlines."""
    middle = 0.5 * (gate.vertices.min(axis=0) + gate.vertices.max(axis=0))
    radius = float(np.linalg.norm(gate.vertices - middle, axis=1).max())
    normal = world_T_body[:3, :3] @ gate.observation.normal
    place = world_T_body[:3, :3] @ middle + world_T_body[:3, 3]
    near = landmarks.near(normal, place, radius + gate.margin, gate.angle)
    return [landmark for landmark, placed in near if _is_plausible(gate, landmark, placed, world_T_body)]


def _is_plausible(gate: _Gate, landmark: Landmark, placed: PlacedPlane, world_T_body: FloatArray) -> bool:
    """Same side, similar direction, and near enough: bounds so wide that the chi2 test decides, not they."""
    plane_T_body = inverse(placed.world_T_plane) @ world_T_body
    if float(plane_T_body[2, :3] @ gate.observation.normal) < np.cos(min(gate.angle, 0.5 * np.pi)):
        return False
    heights = gate.vertices @ plane_T_body[2, :3] + plane_T_body[2, 3]
    if np.abs(heights).min() > gate.margin:
        return False
    return landmark.extent.is_within(gate.margin, gate.observation.patch_in(plane_T_body))
