"""Plane ends: returns that may be of another surface are no evidence for either."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter

from spplanes._check import FloatArray
from spplanes.segmentation.validation.spurious import Window

#: Standard deviations within which the place where a beam meets one plane may lie on another: of returns of two planes
#: that are further apart, one in forty goes to the wrong one.
APART = 4.0
#: Planes whose normals enclose less than this do not meet in a seam: cosine of 30 deg.
_SAME_WAY = 0.866
#: A plane may be met so many scans and beams beyond its points.
_REACH = (1, 12)


def sure_points(window: Window, labels: np.ndarray, frames: Sequence[FloatArray], uneven_m: float) -> np.ndarray:
    """Which points of planes are of no other surface, shape (S, B) bool.

    A return at the end of a plane, the row of ceiling at the top of a wall, is given to what it lies nearer to. So
    either plane gets the errors that suit it and some of the other's points, at its very ends, and leans. Which returns
    these are must not depend on their errors: left out are those whose beam meets the plane where it would meet another
    one within its noise, and those beside a return that is not of the plane.

    Args:
        window: what was segmented.
        labels: plane of every point, shape (S, B), -1 = none.
        frames: of the planes, shape (4, 4) each.
        uneven_m: standard deviation of surfaces from planes, m.
    """
    sure = (labels >= 0) & ~_ends(labels, np.isfinite(window.points[..., 0]))
    masks = [labels == r for r in range(len(frames))]
    near = [maximum_filter(mask, size=tuple(2 * reach + 1 for reach in _REACH)) for mask in masks]
    for a, mine in enumerate(frames):
        for b, other in enumerate(frames):
            if a != b and abs(mine[:3, 2] @ other[:3, 2]) <= _SAME_WAY:
                beside = masks[a] & near[b]
                sure[beside] &= ~_meets_both(window.points[beside], window.covariances[beside], mine, other, uneven_m)
    return sure


def _ends(labels: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Which returns have one beside them in their scan, the next beam's, that is of another label; shape (S, B)."""
    unlike = (labels[:, 1:] != labels[:, :-1]) & valid[:, 1:] & valid[:, :-1]
    ends = np.zeros(labels.shape, dtype=bool)
    ends[:, 1:] |= unlike
    ends[:, :-1] |= unlike
    return ends


def _meets_both(
    points: FloatArray, covariances: FloatArray, mine: FloatArray, other: FloatArray, uneven_m: float
) -> np.ndarray:
    """Whether beams, by their points (N, 3), meet the one plane where they may meet the other, shape (N,) bool."""
    toward = covariances @ mine[:3, 2]
    along = (points - mine[:3, 3]) @ mine[:3, 2] / np.maximum(toward @ mine[:3, 2], 1e-12)
    apart = (points - toward * along[:, None] - other[:3, 3]) @ other[:3, 2]
    variances = np.einsum("nij,i,j->n", covariances, other[:3, 2], other[:3, 2]) + uneven_m**2
    return apart**2 <= APART**2 * variances
