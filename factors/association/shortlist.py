"""Where landmarks lie: which an observation is compared with, by direction, place and outline, and how far they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from shapely.geometry.base import BaseGeometry

from factors.association.decisions import AssociationGates
from factors.association.estimate import AnyLandmark, Estimate, KeyedCovariance, Landmark, PlacedLandmarks, PlacedPlane
from factors.association.gating import State
from factors.association.observations import Observation
from spplanes._check import FloatArray
from spplanes.spmodel import inverse_transform, skew


@dataclass(frozen=True, eq=False)
class Bounds:
    """The bounds about an observation within which the landmarks lie that it may be of."""

    observation: Observation
    vertices: FloatArray
    """Corners of the seen patch in the body frame, shape (N, 3), m."""
    margin: float
    """How far a landmark may lie from where the observation puts it, m."""
    angle: float
    """How much turned it may be, rad: to the other side never."""


def bounds_of(observations: Sequence[Observation], covariance: FloatArray, gates: AssociationGates) -> list[Bounds]:
    """Those of the gates, wider by a pose's (6, 6) marginal covariance, tangent order (rotation, translation)."""
    angle_rad, position_m = (
        float(np.sqrt(max(np.linalg.eigvalsh(covariance[k : k + 3, k : k + 3])[-1], 0.0))) for k in (0, 3)
    )
    bounds, angle = [], min(gates.max_angle_rad + gates.bound_sigmas * angle_rad, 0.5 * np.pi)
    for observation in observations:
        vertices = observation.vertices
        reach = float(np.linalg.norm(vertices, axis=1).max())
        margin = gates.gap_m + gates.bound_sigmas * (position_m + reach * angle_rad)
        bounds.append(Bounds(observation, vertices, margin, angle))
    return bounds


def log_density(bounds: Bounds, n_near: int, gates: AssociationGates) -> float:
    """Log of how many other planes there are about an observation, per rad (of a plane: rad^2) and m.

    As many, and one, lie within the bounds as landmarks do: a place with many walls has more that are not known yet.
    """
    turns = 1 if bounds.observation.kind == "line" else 2
    volume = 2.0 * bounds.margin * (2.0 * bounds.angle) ** turns
    return float(np.log(gates.chance_factor * (n_near + 1) / volume))


def log_parallel_density(bounds: Bounds, n_near: int, gates: AssociationGates) -> float:
    """Log of how many other planes lie parallel to each landmark about an observation, per m.

    Rooms have planes beside planes, cupboards before walls: as many as there are planes turned anyhow.
    """
    return float(np.log(gates.chance_factor * (n_near + 1) / (max(n_near, 1) * 2.0 * bounds.margin)))


def shortlist(bounds: Bounds, landmarks: PlacedLandmarks[AnyLandmark], world_T_body: FloatArray) -> list[AnyLandmark]:
    """Landmarks that the observation is compared with: those near by their bounds, then by their outlines."""
    middle = 0.5 * (bounds.vertices.min(axis=0) + bounds.vertices.max(axis=0))
    radius = float(np.linalg.norm(bounds.vertices - middle, axis=1).max())
    normal = world_T_body[:3, :3] @ bounds.observation.normal
    place = world_T_body[:3, :3] @ middle + world_T_body[:3, 3]
    near = landmarks.near(normal, place, radius + bounds.margin, bounds.angle)
    return [landmark for landmark, placed in near if _is_plausible(bounds, landmark, placed, world_T_body)]


def _is_plausible(bounds: Bounds, landmark: Landmark, placed: PlacedPlane, world_T_body: FloatArray) -> bool:
    """Near enough by what was seen of it: bounds so wide that the chi2 test decides, not they."""
    plane_T_body = inverse_transform(placed.world_T_plane) @ world_T_body
    heights = bounds.vertices @ plane_T_body[2, :3] + plane_T_body[2, 3]
    if np.abs(heights).min() > bounds.margin:
        return False
    return landmark.extent.is_within(bounds.margin, bounds.observation.patch_in(plane_T_body))


@dataclass(frozen=True, eq=False)
class Gaps:
    """How far landmarks, as they were seen, are from where observations of a pose lie; each worked out once."""

    observations: Sequence[Observation]
    landmarks: PlacedLandmarks[Landmark]
    pose_key: int
    estimate: Estimate
    joint: KeyedCovariance
    gates: AssociationGates
    _known: dict[tuple[int, int], float] = field(default_factory=dict, init=False)

    def away(self, index: int, landmark: int) -> float:
        """How much less likely, in nats, a landmark (its id) is for where an observation (its index) lies.

        A factor of e every 0.2 m: a level laser's line half a metre below a notice-board is of the wall behind the
        board.
        """
        return self._near(index, landmark) / 0.2

    def within(self, index: int, landmark: int, state: State) -> bool:
        """Whether a landmark (its id) comes within the bounds of an observation (its index), by all matches so far.

        The bounds of the shortlist are those of a pose of which nothing is matched yet, and of the world: by a pose
        known to a metre all walls of a room in about one plane are near each other. What counts is how well the state
        knows, by now, where the observation is from the landmark.
        """
        if self._near(index, landmark) < self.gates.gap_m:
            return True
        shift, covariance = state.along(*self._by_tangents(index, landmark))
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
        bound = self.gates.gap_m + float(np.linalg.norm(shift)) + self.gates.bound_sigmas * sigma
        return self.landmarks[landmark].extent.is_within(bound, self._patch_on(index, landmark))

    def _near(self, index: int, landmark: int) -> float:
        """Distance of what was seen of both, along the landmark, m; at most the gates' gap."""
        if (index, landmark) not in self._known:
            extent, patch = self.landmarks[landmark].extent, self._patch_on(index, landmark)
            self._known[index, landmark] = extent.distance(patch, self.gates.gap_m)
        return self._known[index, landmark]

    def _patch_on(self, index: int, landmark: int) -> BaseGeometry:
        """What was seen of an observation, in (x, y) of the landmark's plane."""
        plane_T_world = inverse_transform(self.landmarks.placed(landmark).world_T_plane)
        return self.observations[index].patch_in(plane_T_world @ self.estimate.pose(self.pose_key))

    def _by_tangents(self, index: int, landmark: int) -> tuple[np.ndarray, FloatArray]:
        """Columns of pose and anchor in a joint covariance, and by them the observation's middle from the anchor."""
        middle, world_T_body = self.observations[index].vertices.mean(axis=0), self.estimate.pose(self.pose_key)
        keys, blocks = [self.pose_key], [world_T_body[:3, :3] @ np.hstack((-skew(middle), np.eye(3)))]
        anchor = self.landmarks[landmark].anchor_key
        if anchor is not None and anchor != self.pose_key:
            world_T_anchor = self.estimate.pose(anchor)
            there = inverse_transform(world_T_anchor) @ world_T_body @ np.append(middle, 1.0)
            keys.append(anchor)
            blocks.append(world_T_anchor[:3, :3] @ np.hstack((skew(there[:3]), -np.eye(3))))
        return self.joint.columns(keys), np.hstack(blocks)
