"""Paths a simulated robot drives: dense, smooth, parameterised by the way driven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray

#: Distance between the stored points of a path, m.
_STEP_M = 0.005


@dataclass(frozen=True, eq=False)
class Path:
    """A curve on the floor with its heading."""

    way_m: FloatArray
    """Way driven up to each point, shape (K,), m, ascending from 0."""
    poses: FloatArray
    """x, y, heading at each point, shape (K, 3), m, m, rad; the heading is continuous, not wrapped."""

    @property
    def length_m(self) -> float:
        """Length of the whole path, m."""
        return float(self.way_m[-1])

    def at(self, way_m: FloatArray) -> FloatArray:
        """Poses (N, 3) after the ways (N,), m."""
        return np.column_stack([np.interp(way_m, self.way_m, column) for column in self.poses.T])

    @classmethod
    def through(cls, points: ArrayLike) -> Path:
        """The path along a dense curve of points (K, 2); the heading is its tangent."""
        curve = np.asarray(points, dtype=np.float64)
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
        tangent = np.gradient(curve, way, axis=0)
        heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        return cls(way, np.column_stack([curve, heading]))

    @classmethod
    def weaving(cls, length_m: float, *, amplitude_m: float = 0.06, wavelength_m: float = 7.0) -> Path:
        """Along x from the origin, heading 0 at the start, swinging to the left and back by `amplitude_m`."""
        x = np.arange(0.0, length_m + 1.0, _STEP_M)
        return cls.through(np.column_stack([x, amplitude_m * (1.0 - np.cos(2.0 * np.pi * x / wavelength_m)) / 2.0]))


def pose_matrices(poses: FloatArray) -> FloatArray:
    """(N, 4, 4) transforms of poses (N, 3) on the floor."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = c, -s, s, c
    matrices[:, :2, 3] = poses[:, :2]
    return matrices
