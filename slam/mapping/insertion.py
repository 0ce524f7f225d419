"""Insertion: observations on their way into the graph, of known landmarks and of those they start."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam

from factors import plane_factor, plane_landmark
from factors.association.estimate import observation_factor
from slam.association.data_association import Decision
from slam.backend.estimator import Backend
from slam.config import SlamConfig
from slam.frontend.observations import Observation
from slam.geometry.frames import inverse
from slam.map.landmarks import Landmark, LandmarkMap
from slam.mapping.initialization import group_new
from spplanes._check import FloatArray


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
