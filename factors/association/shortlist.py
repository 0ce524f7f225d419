"""Gating by bounds: which landmarks an observation is compared with, by direction, place and outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factors.association.decisions import OUTLINE_GAP_SCALE_M
from factors.association.estimate import AnyLandmark, Landmark, Landmarks, Placed
from factors.association.gates import AssociationGates
from factors.association.observations import Observation
from spplanes._check import FloatArray
from spplanes.spmodel import inverse_transform


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
class Bounds:
    """The bounds about an observation within which the landmarks lie that it may be of."""

    observation: Observation
    vertices: FloatArray
    """Corners of the seen patch in the body frame, shape (N, 3), m."""
    margin: float
    """How far a landmark may lie from where the observation puts it, m."""
    angle: float
    """How much turned it may be, rad."""

    @classmethod
    def of(cls, observation: Observation, uncertainty: PoseUncertainty, gates: AssociationGates) -> Bounds:
        """Those of the gates, wider by the pose's uncertainty."""
        vertices = observation.vertices
        reach = float(np.linalg.norm(vertices, axis=1).max())
        margin = gates.gap_m + gates.bound_sigmas * (uncertainty.position_m + reach * uncertainty.angle_rad)
        return cls(observation, vertices, margin, gates.max_angle_rad + gates.bound_sigmas * uncertainty.angle_rad)


def log_density(bounds: Bounds, n_near: int, gates: AssociationGates) -> float:
    """Log of how many other planes there are about an observation, per rad (of a plane: rad^2) and m.

    As many, and one, lie within the bounds as landmarks do: a place with many walls has more that are not known yet.
    """
    turns = 1 if bounds.observation.kind == "line" else 2
    volume = 2.0 * bounds.margin * (2.0 * min(bounds.angle, 0.5 * np.pi)) ** turns
    return float(np.log(gates.chance_factor * (n_near + 1) / volume))


def log_parallel_density(bounds: Bounds, n_near: int, gates: AssociationGates) -> float:
    """Log of how many other planes lie parallel to each landmark about an observation, per m.

    Rooms have planes beside planes, cupboards before walls: as many as there are planes turned anyhow.
    """
    return float(np.log(gates.chance_factor * (n_near + 1) / (max(n_near, 1) * 2.0 * bounds.margin)))


def shortlist(bounds: Bounds, landmarks: Landmarks[AnyLandmark], world_T_body: FloatArray) -> list[AnyLandmark]:
    """Landmarks that the observation is compared with: those near by their bounds, then by their outlines."""
    middle = 0.5 * (bounds.vertices.min(axis=0) + bounds.vertices.max(axis=0))
    radius = float(np.linalg.norm(bounds.vertices - middle, axis=1).max())
    normal = world_T_body[:3, :3] @ bounds.observation.normal
    place = world_T_body[:3, :3] @ middle + world_T_body[:3, 3]
    near = landmarks.near(normal, place, radius + bounds.margin, bounds.angle)
    return [landmark for landmark, placed in near if _is_plausible(bounds, landmark, placed, world_T_body)]


def _is_plausible(bounds: Bounds, landmark: Landmark, placed: Placed, world_T_body: FloatArray) -> bool:
    """Same side, similar direction, and near enough: bounds so wide that the chi2 test decides, not they."""
    plane_T_body = inverse_transform(placed.world_T_plane) @ world_T_body
    if float(plane_T_body[2, :3] @ bounds.observation.normal) < np.cos(min(bounds.angle, 0.5 * np.pi)):
        return False
    heights = bounds.vertices @ plane_T_body[2, :3] + plane_T_body[2, 3]
    if np.abs(heights).min() > bounds.margin:
        return False
    return landmark.extent.is_within(bounds.margin, bounds.observation.patch_in(plane_T_body))


class OutlineGap:
    """How much less likely, in nats, landmarks are for where observations lie: worked out once, for who has rivals."""

    def __init__(
        self,
        observations: Sequence[Observation],
        landmarks: Landmarks[Landmark],
        world_T_body: FloatArray,
        gap_m: float,
    ) -> None:
        self._observations, self._landmarks, self._gap_m = observations, landmarks, gap_m
        self._world_T_body = world_T_body
        self._known: dict[tuple[int, int], float] = {}

    def __call__(self, index: int, landmark: int) -> float:
        """For a landmark (its id) and an observation (its index)."""
        if (index, landmark) not in self._known:
            plane_T_body = inverse_transform(self._landmarks.placed(landmark).world_T_plane) @ self._world_T_body
            patch = self._observations[index].patch_in(plane_T_body)
            gap = self._landmarks[landmark].extent.distance(patch, self._gap_m)
            self._known[index, landmark] = gap / OUTLINE_GAP_SCALE_M
        return self._known[index, landmark]
