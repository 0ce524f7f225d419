"""Plane ends: returns that may be of another surface are no evidence for either."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, njit
from spplanes._threads import in_parts
from spplanes.fitting.seams import SAME_WAY, at_seams


@dataclass(frozen=True, eq=False)
class Window:
    """The points of a push-broom window."""

    points: FloatArray
    """Shape (S, B, 3), m."""
    covariances: FloatArray
    """Shape (S, B, 3, 3), m^2."""
    pose_covariances: FloatArray
    """Joint covariance of the poses of the scans, shape (6 S, 6 S), in the order of the SPmodel."""


def sure_points(window: Window, labels: np.ndarray, frames: Sequence[FloatArray], uneven_m: float) -> np.ndarray:
    """Which points of planes are of no other surface, shape (S, B) bool.

    A return at the end of a plane, the row of ceiling at the top of a wall, is given to what it lies nearer to. So
    either plane gets the errors that suit it and some of the other's points, at its very ends, and leans. Which returns
    these are must not depend on their errors: left out are those whose beam meets the plane where it would meet another
    one within its noise, and those beside a return of no plane, or of one that looks the same way: what is before or
    behind a wall begins somewhere between two beams, and nothing says on which side of it a return is.

    Args:
        window: what was segmented.
        labels: plane of every point, shape (S, B), -1 = none.
        frames: of the planes, shape (4, 4) each.
        uneven_m: standard deviation of surfaces from planes, m.
    """
    if not len(frames):
        return labels >= 0
    stacked, covariance = np.array(frames), np.ascontiguousarray(window.covariances).reshape(*labels.shape, 9)
    doubtful = at_seams(window.points, covariance, labels, stacked, uneven_m)
    alike = np.abs(stacked[:, :3, 2] @ stacked[:, :3, 2].T) > SAME_WAY
    grid = np.isfinite(window.points[..., 0]), np.ascontiguousarray(labels, dtype=np.int64)
    in_parts(lambda first, last: _find_ends(grid, alike, first, last, doubtful), len(labels), labels.size)
    return (labels >= 0) & ~doubtful


@njit(cache=True)
def _find_ends(grid, alike, first, last, found):
    """Set `found`, in the rows from first to last, for points of a plane beside what may be before or behind it."""
    valid, labels = grid
    for i in range(first, last):
        for j in range(labels.shape[1]):
            if labels[i, j] >= 0 and _ends_beside(valid, labels, alike, i, j, labels[i, j]):
                found[i, j] = True


@inlined
def _ends_beside(valid, labels, alike, i, j, mine):
    """Whether a return beside a point is of no plane, or of another that looks the same way, and so is what follows."""
    n_rows, n_cols = labels.shape
    for step in range(4):
        down, right = (step == 1) - (step == 0), (step == 3) - (step == 2)
        a, b = i + down, j + right
        if not (0 <= a < n_rows and 0 <= b < n_cols and valid[a, b]) or labels[a, b] == mine:
            continue
        if labels[a, b] >= 0 and not alike[mine, labels[a, b]]:
            continue
        a, b = a + down, b + right
        if not (0 <= a < n_rows and 0 <= b < n_cols and labels[a, b] == mine):
            return True
    return False
