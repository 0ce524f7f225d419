"""A body whose motion is hardly known finds its place among the landmarks before its observations are matched."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from factors._conventions import POSE3_TO_SP
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import PlaneObservation
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse
from slam.geometry.polygons import polygonal
from slam.map.landmarks import Landmark, LandmarkMap
from slam.registration.plane_registration import match_planes_widely
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


@dataclass(frozen=True, eq=False)
class FoundPlace:
    """Where a body is by the planes it sees again."""

    motion: Motion
    """The motion to there; it stands in for the real one while observations are matched."""
    seen_again: frozenset[int]
    """Indices of the observations that found it."""

    @property
    def trusted(self) -> frozenset[int] | None:
        """Observations that may be matched; None: all.

        Where even the planes leave a place open, a plane that was not seen again there fits any landmark along the
        open direction: the next of a row of pillars as well as the first. Lines, which find no place, wait as well.
        """
        return self.seen_again if is_wide(self.motion) else None


def found_place(
    keyframe: Keyframe, index: int, motion: Motion, world_T_a: FloatArray, landmarks: LandmarkMap
) -> FoundPlace | None:
    """The place from which most of what a keyframe sees was seen before; None when that cannot be said.

    Its motion is used for matching observations and for nothing later: it holds what they will say.

    Args:
        keyframe: what is seen.
        index: its index.
        motion: what is known of its motion.
        world_T_a: the pose before, shape (4, 4).
        landmarks: as of the last refresh.
    """
    numbers = [k for k, one in enumerate(keyframe.observations) if isinstance(one, PlaneObservation)]
    seen = [one.plane for one in keyframe.observations if isinstance(one, PlaneObservation)]
    expected_T_world = inverse(world_T_a @ motion.a_T_b)
    recent = [one for one in landmarks if one.was_seen_between(index - _RECENT, index)]
    known = [_placed(one, landmarks).transform(expected_T_world) for one in recent]
    found = match_planes_widely(seen, known, _sigmas(motion))
    if found is None:
        return None
    covariance = _SLACK**2 * found.covariance[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
    covariance = covariance + np.diag(np.repeat([_LEAST_M**2, _LEAST_RAD**2], 3))
    there = replace(motion, a_T_b=motion.a_T_b @ found.known_T_seen, covariance=covariance, response=None)
    return FoundPlace(there, frozenset(numbers[i] for i, _ in found.pairs))


def _placed(landmark: Landmark, landmarks: LandmarkMap) -> Plane:
    """A landmark with all parts that were seen of it: a wall behind pillars has many."""
    frame, outline = landmarks.placed(landmark.id).world_T_plane, polygonal(landmark.outline)
    return Plane._trusted(frame, 1e-6 * np.eye(3), landmark.n_points, outline)  # type: ignore[arg-type]


def _sigmas(motion: Motion) -> tuple[float, float]:
    """Largest standard deviation of position and of orientation, m and rad."""
    split = 2 if motion.is_planar else 3
    place, turn = motion.covariance[:split, :split], motion.covariance[split:, split:]
    return tuple(float(np.sqrt(np.linalg.eigvalsh(block)[-1])) for block in (place, turn))  # type: ignore[return-value]
