"""A body whose motion is hardly known finds its place among the landmarks before its observations are matched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from factors._conventions import POSE3_TO_SP
from slam.frames import inverse
from slam.keyframes import Keyframe
from slam.landmarks import Landmark, LandmarkMap
from slam.observations import PlaneObservation
from slam.odometry import Motion
from slam.outlines import largest_polygon
from slam.plane_matching import match_planes_widely
from spplanes import Plane
from spplanes._check import FloatArray

#: A motion known worse than this is looked for by the planes, m and rad.
_WIDE_M, _WIDE_RAD = 0.25, 0.12
#: Landmarks that so many keyframes before have seen are looked for.
_RECENT = 6
#: What least squares over pairs leaves out, segmentation above all, against its covariance: factor, and least, m, rad.
_SLACK, _LEAST_M, _LEAST_RAD = 1.5, 0.02, 0.004


def is_wide(motion: Motion) -> bool:
    """Whether so little is known of a motion that single planes cannot be told apart by it."""
    place, turn = _sigmas(motion)
    return place > _WIDE_M or turn > _WIDE_RAD


def found_motion(
    keyframe: Keyframe, index: int, motion: Motion, world_T_a: FloatArray, landmarks: LandmarkMap
) -> Motion | None:
    """The motion by which most of what a keyframe sees was seen before; None when that cannot be said.

    It stands in for the real one while observations are matched, and for no longer: it holds what they will say.

    Args:
        keyframe: what is seen.
        index: its index.
        motion: what is known of its motion.
        world_T_a: the pose before, shape (4, 4).
        landmarks: as of the last refresh.
    """
    seen = [one.plane for one in keyframe.observations if isinstance(one, PlaneObservation)]
    expected_T_world = inverse(world_T_a @ motion.a_T_b)
    recent = [one for one in landmarks if one.was_seen_between(index - _RECENT, index)]
    known = [_placed(one, landmarks).transform(expected_T_world) for one in recent]
    found = match_planes_widely(seen, known, _sigmas(motion))
    if found is None:
        return None
    covariance = _SLACK**2 * found.covariance[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
    covariance = covariance + np.diag(np.repeat([_LEAST_M**2, _LEAST_RAD**2], 3))
    return replace(motion, a_T_b=motion.a_T_b @ found.known_T_seen, covariance=covariance, response=None)


def _placed(landmark: Landmark, landmarks: LandmarkMap) -> Plane:
    frame = landmarks.placed(landmark.id).world_T_plane
    return Plane._trusted(frame, 1e-6 * np.eye(3), landmark.n_points, largest_polygon(landmark.outline))


def _sigmas(motion: Motion) -> tuple[float, float]:
    """Largest standard deviation of position and of orientation, m and rad."""
    split = 2 if motion.is_planar else 3
    place, turn = motion.covariance[:split, :split], motion.covariance[split:, split:]
    return tuple(float(np.sqrt(np.linalg.eigvalsh(block)[-1])) for block in (place, turn))  # type: ignore[return-value]
