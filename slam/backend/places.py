"""Place matches with what the graph holds: the earlier keyframe may have left it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam.backend.estimator import Backend, pose_symbol
from slam.frontend.odometry import planar_delta
from slam.frontend.pose_measurements import PlaceMatch
from slam.geometry.frames import planar_transform
from spplanes._check import FloatArray


class Anchored(NamedTuple):
    """A match with a pose in the graph."""

    key: int
    """Of that pose."""
    delta: FloatArray
    """(x, y, theta) of the later keyframe in its frame, shape (3,)."""
    covariance: FloatArray
    """Its covariance, x and y along the axes of that pose, shape (3, 3)."""


def anchored(match: PlaceMatch, backend: Backend) -> Anchored:
    """A match by the pose that the earlier keyframe moves with, itself where it is in the graph."""
    key, base_T_old = backend.rigid_base(pose_symbol(match.keyframe))
    turn = np.eye(3)
    turn[:2, :2] = base_T_old[:2, :2]
    delta = planar_delta(base_T_old @ planar_transform(*match.delta))
    return Anchored(key, delta, turn @ match.covariance @ turn.T)
