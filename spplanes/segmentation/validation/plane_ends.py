"""Plane ends: returns that may be of another surface are no evidence for either."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spplanes._check import FloatArray
from spplanes.fitting.seams import SAME_WAY, at_seams


@dataclass(frozen=True, eq=False)
class Window:
    """The points of a push-broom window."""

    points: FloatArray
    covariances: FloatArray
    """Shape (S, B, 3, 3), m^2."""
    pose_covariances: FloatArray
    """Joint covariance of the poses of the scans, shape (6 S, 6 S), in the order of the SPmodel."""


def sure_points(window: Window, labels: np.ndarray, frames: Sequence[FloatArray], uneven_m: float) -> np.ndarray:
    """Which points of planes are of no other surface, shape (S, B) bool; `uneven_m` is that of surfaces from planes.

    A return at the end of a plane, the row of ceiling at the top of a wall, is given to what it lies nearer to. So
    either plane gets the errors that suit it and some of the other's points, at its very ends, and leans. Which returns
    these are must not depend on their errors: left out are those whose beam meets the plane where it would meet another
    one within its noise, and those beside a return of no plane, or of one that looks the same way: what is before or
    behind a wall begins somewhere between two beams, and nothing says on which side of it a return is.
    """
    if not len(frames):
        return labels >= 0
    stacked, covariance = np.array(frames), np.ascontiguousarray(window.covariances).reshape(*labels.shape, 9)
    doubtful = at_seams(window.points, covariance, labels, stacked, uneven_m)
    alike = np.abs(stacked[:, :3, 2] @ stacked[:, :3, 2].T) > SAME_WAY
    n_rows, n_cols = labels.shape
    around, returns = np.pad(labels, 2, constant_values=-1), np.pad(np.isfinite(window.points[..., 0]), 2)
    at_ends = np.zeros(labels.shape, dtype=bool)
    for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        beside, beyond = (
            (slice(2 + k * down, 2 + k * down + n_rows), slice(2 + k * right, 2 + k * right + n_cols)) for k in (1, 2)
        )
        other = around[beside]
        told_apart = (other >= 0) & ~alike[labels, other]
        at_ends |= returns[beside] & (other != labels) & ~told_apart & (around[beyond] != labels)
    return (labels >= 0) & ~doubtful & ~at_ends
