"""Insertion: observations on their way into the graph, of known landmarks and of those they start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from factors import plane_factor, plane_landmark
from factors.association.estimate import observation_factor
from factors.association.grouping import group_planes
from slam.backend.estimator import Backend
from slam.config import AssociationConfig, LandmarkConfig, SlamConfig
from slam.frontend.observations import LineObservation, Observation
from slam.geometry.frames import inverse
from slam.map.data_association import Decision, gates_of
from slam.map.landmarks import Landmark, LandmarkMap
from spplanes import Plane
from spplanes._check import FloatArray

#: A plane of so many points whose tilt is known to this share of what is asked starts a landmark though it has only
#: this share of the area asked: a push-broom window sees half a metre of anything.
FIRM_POINTS, FIRM_TILT, FIRM_AREA = 200, 0.2, 0.5


def may_start(observation: Observation, rules: LandmarkConfig) -> bool:
    """Whether a measurement is firm enough to start a landmark."""
    if isinstance(observation, LineObservation):
        ends = observation.vertices
        long_enough = float(np.linalg.norm(ends[1] - ends[0])) >= rules.min_line_length_m
        return long_enough and observation.n_points >= rules.min_line_points
    plane = observation.full_plane(0.0)
    tilt = float(np.sqrt(np.linalg.eigvalsh(plane.covariance[1:, 1:])[-1]))
    return (is_large(plane, rules) and tilt <= rules.max_tilt_sigma_rad) or _is_firm(plane, tilt, rules)


def _is_firm(plane: Plane, tilt: float, rules: LandmarkConfig) -> bool:
    """Whether a patch too small to start a landmark is too sure to be the edge of something: the front of a lamp."""
    return (
        plane.n_points >= FIRM_POINTS
        and tilt <= FIRM_TILT * rules.max_tilt_sigma_rad
        and plane.outline is not None
        and plane.outline.area >= FIRM_AREA * rules.min_area_m2
    )


def is_large(plane: Plane, rules: LandmarkConfig) -> bool:
    """Whether a patch is large enough to be more than the edge of something."""
    return plane.n_points >= rules.min_points and (plane.outline is None or plane.outline.area >= rules.min_area_m2)


def group_new(
    observations: Sequence[Observation], rules: LandmarkConfig, association: AssociationConfig
) -> list[list[int]]:
    """Gather measurements of one keyframe that are one plane; the first of each group, the firmest, starts it.

    Measurements that may not start a landmark join a group but do not make one.

    Returns:
        Groups of indices into `observations`, in order of their first member.
    """
    firm = [may_start(observation, rules) for observation in observations]
    return group_planes(observations, gates_of(association), rules.wall_tilt_sigma_rad, firm)


@dataclass(frozen=True, eq=False)
class Insertion:
    """An observation on its way into the graph."""

    landmark: Landmark
    """What it is of."""
    observation: Observation
    """The measurement."""
    number: int
    """Its index in the keyframe."""
    factor: Any
    """Its factor."""
    plane_T_body: FloatArray
    """The keyframe's body in the landmark's plane frame, shape (4, 4)."""


def insert_matches(
    observations: Sequence[Observation],
    pose_key: int,
    decisions: Sequence[Decision],
    landmarks: LandmarkMap,
    backend: Backend,
    robust: str | None,
) -> list[Insertion]:
    """Factors of the observations that were matched to a landmark, with a robust kernel or without."""
    insertions = []
    for decision in decisions:
        if decision.match is None:
            continue
        observation = observations[decision.observation]
        landmark = landmarks[decision.match.landmark]
        factor = observation_factor(observation, pose_key, landmark, backend, robust)
        plane_T_body = inverse(landmarks.placed(landmark.id).world_T_plane) @ backend.pose(pose_key)
        insertions.append(Insertion(landmark, observation, decision.observation, factor, plane_T_body))
    return insertions


def initialize_landmarks(
    seen: Sequence[Observation],
    pose_keys: tuple[int, int],
    decisions: Sequence[Decision],
    landmarks: LandmarkMap,
    backend: Backend,
    config: SlamConfig,
    initial: gtsam.Values,
) -> list[Insertion]:
    """Landmarks of what no landmark explains, each with every observation of this keyframe that is its plane.

    Args:
        seen: the keyframe's observations.
        pose_keys: of the anchor and of the keyframe. The anchor is a pose before: of its own pose, a landmark's first
            factor would be custom, thus slow.
        decisions: one an observation.
        landmarks: where they are born.
        backend, config: the state, the rules.
        initial: takes the estimates of the new variables.
    """
    numbers = [decision.observation for decision in decisions if decision.verdict == "new"]
    observations = [seen[number] for number in numbers]
    anchor_key, pose_key = pose_keys
    anchor_T_body = inverse(backend.pose(anchor_key)) @ backend.pose(pose_key)
    insertions = []
    for group in group_new(observations, config.landmarks, config.association):
        plane = observations[group[0]].full_plane(config.landmarks.wall_tilt_sigma_rad)
        anchored = plane.transform(anchor_T_body)
        plane_T_body = inverse(anchored.frame) @ anchor_T_body
        landmark = landmarks.birth(observations[group[0]], anchor_key, anchored.frame, plane_T_body)
        initial.insert(landmark.key, plane_landmark(anchored))
        factor = plane_factor(plane, pose_key, landmark.key, anchor_key=anchor_key)
        insertions.append(Insertion(landmark, observations[group[0]], numbers[group[0]], factor, plane_T_body))
        for member in group[1:]:
            observation, robust = observations[member], config.backend.robust
            factor = observation.factor(pose_key, landmark.key, anchor_key, robust, plane_landmark(plane))
            insertions.append(Insertion(landmark, observation, numbers[member], factor, plane_T_body))
    return insertions
