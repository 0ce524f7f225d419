"""How far landmarks, as they were seen, are from where observations lie: between rivals, and for any match."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from shapely.geometry.base import BaseGeometry

from factors.association.decisions import OUTLINE_GAP_SCALE_M, AssociationGates
from factors.association.estimate import Estimate, Joint, Landmark, Landmarks
from factors.association.gating import State
from factors.association.observations import Observation
from spplanes._check import FloatArray
from spplanes.spmodel import inverse_transform, skew


class Gaps:
    """How far landmarks, as they were seen, are from where observations of a pose lie; each worked out once."""

    def __init__(
        self,
        observations: Sequence[Observation],
        landmarks: Landmarks[Landmark],
        pose_key: int,
        estimate: Estimate,
        joint: Joint,
        gates: AssociationGates,
    ) -> None:
        self._observations, self._landmarks, self._gates = observations, landmarks, gates
        self._pose_key, self._estimate, self._joint = pose_key, estimate, joint
        self._world_T_body = estimate.pose(pose_key)
        self._near = cache(self._distance)

    def away(self, index: int, landmark: int) -> float:
        """How much less likely, in nats, a landmark (its id) is for where an observation (its index) lies.

        For those that have rivals.
        """
        return self._near(index, landmark) / OUTLINE_GAP_SCALE_M

    def within(self, index: int, landmark: int, state: State) -> bool:
        """Whether a landmark (its id) comes within the bounds of an observation (its index), by all matches so far.

        The bounds of the shortlist are those of a pose of which nothing is matched yet, and of the world: by a pose
        known to a metre all walls of a room in about one plane are near each other. What counts is how well the state
        knows, by now, where the observation is from the landmark.
        """
        if self._near(index, landmark) < self._gates.gap_m:
            return True
        shift, covariance = state.along(*self._by_tangents(index, landmark))
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
        bound = self._gates.gap_m + float(np.linalg.norm(shift)) + self._gates.bound_sigmas * sigma
        return self._landmarks[landmark].extent.is_within(bound, self._patch_on(index, landmark))

    def _distance(self, index: int, landmark: int) -> float:
        """Of what was seen of both, along the landmark, m; at most the gates' gap."""
        return self._landmarks[landmark].extent.distance(self._patch_on(index, landmark), self._gates.gap_m)

    def _patch_on(self, index: int, landmark: int) -> BaseGeometry:
        """What was seen of an observation, in (x, y) of the landmark's plane."""
        plane_T_body = inverse_transform(self._landmarks.placed(landmark).world_T_plane) @ self._world_T_body
        return self._observations[index].patch_in(plane_T_body)

    def _by_tangents(self, index: int, landmark: int) -> tuple[np.ndarray, FloatArray]:
        """Columns of pose and anchor in a joint covariance, and by them the observation's middle from the anchor."""
        middle, rotation = self._observations[index].vertices.mean(axis=0), self._world_T_body[:3, :3]
        keys, blocks = [self._pose_key], [rotation @ np.hstack((-skew(middle), np.eye(3)))]
        anchor = self._landmarks[landmark].anchor_key
        if anchor is not None and anchor != self._pose_key:
            world_T_anchor = self._estimate.pose(anchor)
            there = inverse_transform(world_T_anchor) @ self._world_T_body @ np.append(middle, 1.0)
            keys.append(anchor)
            blocks.append(world_T_anchor[:3, :3] @ np.hstack((skew(there[:3]), -np.eye(3))))
        return self._joint.columns(keys), np.hstack(blocks)
