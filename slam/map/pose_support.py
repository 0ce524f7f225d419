"""How far back what was seen still supports the newest pose: before that, keyframes may leave the graph."""

from __future__ import annotations

from collections.abc import Iterable

import gtsam
import numpy as np

from factors._conventions import SP_TO_POSE3
from slam.frontend.information import floor_information, plane_information
from slam.frontend.observations import Observation
from slam.frontend.odometry import Motion, spatial_covariance
from spplanes._check import FloatArray

#: Variance of a pose of which nothing is known, m^2 and rad^2.
_UNKNOWN = 1e4
#: A pose is known as well by less when no variance is larger by more than this factor: 10 % of a standard deviation.
_AS_WELL = 1.2


class PoseSupport:
    """Follows how well the newest pose is known in the map by all that was seen, and by the latest part of it alone.

    Along a corridor that part reaches back to the last end wall or door frame; where all directions are seen at once it
    is a keyframe or two. Two Kalman filters of the pose with the map taken as known, without their means.
    """

    def __init__(self) -> None:
        self._by_all = _UNKNOWN * np.eye(6)
        self._by_late = _UNKNOWN * np.eye(6)
        self._late_from = 0
        self.needed_from = 0
        """What was seen before this keyframe tells nothing of the newest pose that was not seen since."""

    def step(self, keyframe: int, motion: Motion | None, matched: Iterable[Observation]) -> None:
        """A keyframe has come by a motion, None where nobody measured it, and saw known planes."""
        information = sum((plane_information(one) for one in matched), start=floor_information(motion))
        self._by_all = _seen(_moved(self._by_all, motion), information)
        self._by_late = _seen(_moved(self._by_late, motion), information)
        root = np.linalg.cholesky(self._by_all)
        whitened = np.linalg.solve(root, np.linalg.solve(root, self._by_late).T)
        if np.linalg.eigvalsh(0.5 * (whitened + whitened.T))[-1] <= _AS_WELL:
            self.needed_from, self._late_from = self._late_from, keyframe
            self._by_late = _seen(_UNKNOWN * np.eye(6), information)


def _moved(covariance: FloatArray, motion: Motion | None) -> FloatArray:
    if motion is None:
        return _UNKNOWN * np.eye(6)
    carry = gtsam.Pose3(motion.a_T_b).inverse().AdjointMap()
    own = motion.covariance
    if motion.is_planar:
        own = spatial_covariance(own, motion.a_T_b, motion.out_of_plane_sigmas)
    return carry @ covariance @ carry.T + own[np.ix_(SP_TO_POSE3, SP_TO_POSE3)]


def _seen(covariance: FloatArray, information: FloatArray) -> FloatArray:
    """By a square root: a difference of inverses is not symmetric where much is unknown and much is told."""
    root = np.linalg.cholesky(covariance)
    half = np.linalg.solve(np.linalg.cholesky(np.eye(6) + root.T @ information @ root), root.T)
    return np.asarray(half.T @ half, dtype=np.float64)
