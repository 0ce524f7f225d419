"""Which landmark is it: chi2 with measurement and state covariance, the side, and where it was seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2 as chi2_distribution

from slam.backend import Backend, JointCovariance
from slam.config import AssociationConfig
from slam.frames import inverse
from slam.landmarks import Landmark, LandmarkMap, PlacedPlane
from slam.observations import Observation
from spplanes._check import FloatArray

#: Bounds drawn from a standard deviation are taken at this many of them.
_SIGMAS = 3.0


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
    """Log density of the measurement under this landmark, up to a constant."""

    @property
    def p_value(self) -> float:
        """Probability of a larger chi2 if it is the same plane."""
        return float(chi2_distribution.sf(self.chi2, self.dof))


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
    """All landmarks it was compared with, most likely first."""


def associate(
    observations: Sequence[Observation],
    pose_key: int,
    landmarks: LandmarkMap,
    backend: Backend,
    config: AssociationConfig,
) -> list[Decision]:
    """Decide for every observation of a keyframe whose pose is already predicted in the graph.

    The chi2 is the factor's own: with A and b its whitened linearisation and P the joint marginal covariance of pose,
    anchor and landmark, chi2 = b^T (A P A^T + I)^-1 b. So the gate tests exactly what the graph will be told.
    """
    world_T_body = backend.pose(pose_key)
    spread = Spread.of(backend.covariance(pose_key))
    shortlists = [
        [
            landmark
            for landmark, placed in landmarks.placements()
            if _is_plausible(observation, landmark, placed, world_T_body, spread, config)
        ]
        for observation in observations
    ]
    joint = _joint_covariance(shortlists, pose_key, backend)
    return [
        _decide(index, _compare(observation, shortlist, pose_key, joint, backend), config)
        for index, (observation, shortlist) in enumerate(zip(observations, shortlists, strict=True))
    ]


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


def _is_plausible(
    observation: Observation,
    landmark: Landmark,
    placed: PlacedPlane,
    world_T_body: FloatArray,
    spread: Spread,
    config: AssociationConfig,
) -> bool:
    """Same side, similar direction, and near enough: bounds so wide that the chi2 test decides, not they."""
    plane_T_body = inverse(placed.world_T_plane) @ world_T_body
    cosine = float(plane_T_body[2, :3] @ observation.normal)
    angle = config.max_angle_rad + _SIGMAS * spread.angle_rad
    if cosine < np.cos(min(angle, 0.5 * np.pi)):
        return False
    heights = observation.vertices @ plane_T_body[2, :3] + plane_T_body[2, 3]
    reach = float(np.linalg.norm(observation.vertices, axis=1).max(initial=0.0))
    margin = config.gap_m + _SIGMAS * (spread.position_m + reach * spread.angle_rad)
    if np.abs(heights).min() > margin:
        return False
    return landmark.outline.distance(observation.patch_in(plane_T_body)) <= margin


def _joint_covariance(shortlists: Sequence[Sequence[Landmark]], pose_key: int, backend: Backend) -> JointCovariance:
    """One joint marginal for all candidates of the keyframe: asking once is cheaper than asking for every pair."""
    keys = {pose_key}
    for shortlist in shortlists:
        for landmark in shortlist:
            keys.update((landmark.key, landmark.anchor_key))
    return backend.joint_covariance(sorted(keys))


def _compare(
    observation: Observation,
    shortlist: Sequence[Landmark],
    pose_key: int,
    joint: JointCovariance,
    backend: Backend,
) -> list[Candidate]:
    """The candidates of one observation, most likely first; equals in order of their birth."""
    candidates = []
    for landmark in shortlist:
        factor = observation.factor(pose_key, landmark.key, landmark.anchor_key)
        linear = factor.linearize(backend.values)
        jacobian, residual = linear.jacobian()
        innovation = jacobian @ joint.of(list(linear.keys())) @ jacobian.T + np.eye(len(residual))
        chi2 = float(residual @ np.linalg.solve(innovation, residual))
        log_likelihood = -0.5 * (chi2 + float(np.linalg.slogdet(innovation)[1]))
        candidates.append(Candidate(landmark.id, chi2, len(residual), log_likelihood))
    return sorted(candidates, key=lambda candidate: (-candidate.log_likelihood, candidate.landmark))


def _decide(index: int, candidates: list[Candidate], config: AssociationConfig) -> Decision:
    accepted = [candidate for candidate in candidates if candidate.p_value >= config.significance]
    if accepted:
        return Decision(index, "match", accepted[0], tuple(candidates))
    near = any(candidate.p_value >= config.new_significance for candidate in candidates)
    return Decision(index, "unsure" if near else "new", None, tuple(candidates))
