"""Paths a simulated robot drives: dense, smooth, parameterised by the way driven."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

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
        phase = 2.0 * np.pi * x / wavelength_m
        path = cls.through(np.column_stack([x, amplitude_m * (1.0 - np.cos(phase)) / 2.0]))
        path.poses[:, 2] = np.arctan(amplitude_m * np.pi / wavelength_m * np.sin(phase))  # exactly 0 at the start
        return path

    @classmethod
    def rounded(cls, points: Sequence[tuple[float, float]], radius_m: float) -> Path:
        """Straight from point to point, each corner between cut by an arc of `radius_m`; the first heading is a side's.

        Raises:
            ValueError: an arc does not fit between its neighbours.
        """
        pieces: list[FloatArray] = []
        corners = np.asarray(points, dtype=np.float64)
        here = corners[0]
        for corner, following in pairwise(corners[1:]):
            arc = _arc(here, corner, following, radius_m)
            if (arc[0] - here) @ (corner - here) < 0.0 or (following - arc[-1]) @ (following - corner) < 0.0:
                raise ValueError(f"radius_m: expected arcs that fit between the points, got {radius_m} at {corner}")
            pieces += [_straight(here, arc[0]), arc[:-1]]
            here = arc[-1]
        return cls.through(np.vstack([*pieces, _straight(here, corners[-1]), corners[-1:]]))


def _straight(start: FloatArray, end: FloatArray) -> FloatArray:
    """Points (K, 2) from start to just before end."""
    count = max(int(np.ceil(np.linalg.norm(end - start) / _STEP_M)), 1)
    return start + np.arange(count)[:, None] / count * (end - start)


def _arc(before: FloatArray, corner: FloatArray, after: FloatArray, radius_m: float) -> FloatArray:
    """Points (K, 2) of the arc that touches both sides of a corner, from one touching point to the other."""
    incoming, outgoing = corner - before, after - corner
    incoming, outgoing = incoming / np.linalg.norm(incoming), outgoing / np.linalg.norm(outgoing)
    turn = np.arctan2(incoming[0] * outgoing[1] - incoming[1] * outgoing[0], incoming @ outgoing)
    start = corner - incoming * radius_m * np.tan(abs(turn) / 2.0)
    left = np.sign(turn) * np.array([-incoming[1], incoming[0]])
    angles = np.linspace(0.0, turn, max(int(abs(turn) * radius_m / _STEP_M), 2))
    c, s = np.cos(angles)[:, None], np.sin(np.abs(angles))[:, None]
    return start + radius_m * (left * (1.0 - c) + incoming * s)


def pose_matrices(poses: FloatArray) -> FloatArray:
    """(N, 4, 4) transforms of poses (N, 3) on the floor."""
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    matrices = np.tile(np.eye(4), (len(poses), 1, 1))
    matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 0], matrices[:, 1, 1] = c, -s, s, c
    matrices[:, :2, 3] = poses[:, :2]
    return matrices
