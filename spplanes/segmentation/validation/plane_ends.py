"""Plane ends: returns that may be of another surface are no evidence for either."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, njit
from spplanes._threads import in_parts
from spplanes.segmentation.refinement.dissolving import near_pairs

#: Standard deviations within which the place where a beam meets one plane may lie on another: of returns of two planes
#: that are further apart, one in forty goes to the wrong one.
APART = 4.0
#: Planes whose normals enclose less than this do not meet in a seam: cosine of 30 deg.
_SAME_WAY = 0.866
#: A plane may be met so many scans and beams beyond its points.
_REACH = 12


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

    The place where a beam meets a plane is where its point is moved to by C n (n.x - d) / (n.C n), along the beam where
    its range alone errs. Both planes are uneven: by as much as the first is, divided by the sine at which the beam
    meets it, that place moves along the beam.

    Args:
        window: what was segmented.
        labels: plane of every point, shape (S, B), -1 = none.
        frames: of the planes, shape (4, 4) each.
        uneven_m: standard deviation of surfaces from planes, m.
    """
    sure = labels >= 0
    if not len(frames):
        return sure
    labels = np.ascontiguousarray(labels, dtype=np.int64)
    planes = np.array([(*frame[:3, 2], frame[:3, 2] @ frame[:3, 3]) for frame in frames])
    alike = np.abs(planes[:, :3] @ planes[:, :3].T) > _SAME_WAY
    grid = window.points, window.covariances, np.isfinite(window.points[..., 0]), labels
    near = _seams(labels, alike)

    def some(first: int, last: int) -> None:
        _leave_out(grid, (planes, alike, *near), uneven_m**2, first, last, sure)

    in_parts(some, len(labels), labels.size)
    return sure


def _seams(labels: np.ndarray, alike: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Planes near each other that do not look the same way: those of plane r are others[start[r] : start[r + 1]]."""
    meet = np.zeros(alike.shape, dtype=bool)
    pairs = near_pairs(labels, _REACH)
    meet[pairs[:, 0], pairs[:, 1]] = True
    ours, others = np.nonzero((meet | meet.T) & ~alike)
    return np.searchsorted(ours, np.arange(len(alike) + 1)), np.ascontiguousarray(others)


@njit(cache=True)
def _leave_out(grid, regions, uneven, first, last, sure):
    """Clear `sure`, in the rows from first to last, where a point of a plane may be of another surface."""
    (points, covariances, valid, labels), (planes, alike, start, others) = grid, regions
    toward = np.empty(3)
    for i in range(first, last):
        for j in range(labels.shape[1]):
            mine = labels[i, j]
            if mine < 0:
                continue
            if _ends_beside(valid, labels, alike, i, j, mine):
                sure[i, j] = False
                continue
            own, off = 0.0, -planes[mine, 3]
            for k in range(3):
                toward[k] = 0.0
                for m in range(3):
                    toward[k] += covariances[i, j, k, m] * planes[mine, m]
                own += planes[mine, k] * toward[k]
                off += planes[mine, k] * points[i, j, k]
            own = max(own, 1e-12)
            for k in range(start[mine], start[mine + 1]):
                other = planes[others[k]]
                ratio = (other[0] * toward[0] + other[1] * toward[1] + other[2] * toward[2]) / own
                apart = -other[3] - ratio * off
                for m in range(3):
                    apart += other[m] * points[i, j, m]
                if _meets(apart, covariances, i, j, other, uneven * (1.0 + ratio * ratio)) and _is_near(
                    labels, i, j, others[k]
                ):
                    sure[i, j] = False
                    break


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


@inlined
def _meets(apart, covariances, i, j, other, variance):
    """Whether a place so far from a plane (normal, d) may lie on it, by a beam's noise and a variance beside it."""
    most = variance
    for k in range(3):
        most += covariances[i, j, k, k]
    if apart * apart > APART * APART * most:  # as nearly always: no noise along a direction exceeds the trace
        return False
    for k in range(3):
        for m in range(3):
            variance += other[k] * covariances[i, j, k, m] * other[m]
    return apart * apart <= APART * APART * variance


@inlined
def _is_near(labels, i, j, other):
    """Whether a plane has points so few scans and beams from a place."""
    for a in range(max(i - _REACH, 0), min(i + _REACH + 1, labels.shape[0])):
        for b in range(max(j - _REACH, 0), min(j + _REACH + 1, labels.shape[1])):
            if labels[a, b] == other:
                return True
    return False
