"""Landmarks that are one plane become one: the younger's factors are re-keyed to the older, inside iSAM2."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import gtsam

from slam.backend import Backend, pose_symbol
from slam.frames import inverse
from slam.keyframes import Keyframe
from slam.landmarks import Landmark, LandmarkMap, observe


def absorb(
    older: Landmark,
    younger: Landmark,
    keyframes: Sequence[Keyframe],
    landmarks: LandmarkMap,
    backend: Backend,
    robust: str | None = None,
) -> None:
    """Give a landmark everything that was seen of another one, which is out of the map already."""
    factors = []
    for sighting in younger.sightings:
        observation = keyframes[sighting.keyframe].observations[sighting.observation]
        factors.append(observe(observation, pose_symbol(sighting.keyframe), older, backend, robust))
    gone = [sighting.factor_index for sighting in younger.sightings]
    indices = backend.update(factors, gtsam.Values(), remove=gone, relinearize=True)
    older_T_world = inverse(landmarks.placed(older.id).world_T_plane)
    for sighting, factor_index in zip(younger.sightings, indices, strict=True):
        observation = keyframes[sighting.keyframe].observations[sighting.observation]
        plane_T_body = older_T_world @ backend.pose(pose_symbol(sighting.keyframe))
        landmarks.see(older, observation, replace(sighting, factor_index=factor_index), plane_T_body)
