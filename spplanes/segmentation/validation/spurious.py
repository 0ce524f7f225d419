"""Spurious planes of a push-broom window: those whose points their neighbours explain better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter

from spplanes._check import FloatArray

#: Chi2 by which the others must explain the points of a plane better than itself for it to be none: what its three
#: parameters gain by chance at 0.001.
GAIN = 16.3
#: Standard deviations of its own chi2 beyond which a plane fits its points badly: then any gain will do.
MISFIT = 2.0
#: Points are explained by others together with those around them, in squares of so many scans and beams.
AROUND = 3
#: A point explains no more than this of a plane's misfit (chi2).
_MOST = 25.0
#: Planes further apart in direction than this explain nothing of each other: cosine of 30 deg.
_SAME_WAY = 0.866


@dataclass(frozen=True, eq=False)
class Window:
    """The points of a push-broom window."""

    points: FloatArray
    """Shape (S, B, 3), m."""
    covariances: FloatArray
    """Shape (S, B, 3, 3), m^2."""
    pose_covariances: FloatArray
    """Joint covariance of the poses of the scans, shape (6 S, 6 S), in the order of the SPmodel."""


def without_chimeras(window: Window, labels: np.ndarray, frames: Sequence[FloatArray]) -> np.ndarray:
    """Labels where the points of planes that others explain better are those others'.

    Two small parts of a wall and of a board on it, each less than its noise lets tell, pass for one plane that meets
    both, a few degrees turned. The wall and the board explain its points better than it does.

    Args:
        window: the grid.
        labels: plane of every point, shape (S, B), -1 = none.
        frames: of the planes, shape (4, 4) each.

    Returns:
        Shape (S, B); the very same array where nothing changes.
    """
    regions = [Region.of(window, labels == r, frames, r) for r in range(len(frames))]
    fresh, gone = labels, []
    while True:
        gains = [-np.inf if r in gone else region.gain(gone) for r, region in enumerate(regions)]
        worst = int(np.argmax(gains)) if gains else 0
        if not gains or gains[worst] <= 0.0:
            return fresh
        gone.append(worst)
        fresh = fresh.copy() if fresh is labels else fresh
        regions[worst].hand_over(fresh, gone)


@dataclass(frozen=True, eq=False)
class Region:
    """The points of one plane, and what each of the planes makes of them."""

    box: tuple[slice, slice]
    """Where they are in the grid."""
    mask: np.ndarray
    """Which points in the box are of the plane, shape (s, b)."""
    own: int
    """Number of the plane."""
    others: list[int]
    """Numbers of the planes that face the same way."""
    chi2: FloatArray
    """Of every point about the plane itself and about those others, shape (1 + len(others), s, b); else 0."""

    @classmethod
    def of(cls, window: Window, mask: np.ndarray, frames: Sequence[FloatArray], own: int) -> Region:
        """The region of a mask (S, B)."""
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)) if len(rows) else (slice(0), slice(0))
        inside = mask[box]
        others = [r for r, frame in enumerate(frames) if r != own and frame[:3, 2] @ frames[own][:3, 2] > _SAME_WAY]
        points, covariances = window.points[box][inside], window.covariances[box][inside]
        chi2 = np.zeros((1 + len(others), *inside.shape))
        for k, r in enumerate([own, *others]):
            normal = frames[r][:3, 2]
            variances = np.maximum(np.einsum("nij,i,j->n", covariances, normal, normal), 1e-12)
            chi2[k][inside] = np.minimum(((points - frames[r][:3, 3]) @ normal) ** 2 / variances, _MOST)
        return cls(box, inside, own, others, chi2)

    def gain(self, gone: Sequence[int]) -> float:
        """How much better, beyond what is needed, the planes that are left explain the points; not finite: not at all.

        Needed is what the plane's parameters gain by chance, or only that it fits its own points badly.
        """
        left = [k for k, r in enumerate(self.others, 1) if r not in gone]
        if not left:
            return -np.inf
        mine, dof = float(self.chi2[0].sum()), float(np.count_nonzero(self.mask) - 3)
        theirs = float(np.take_along_axis(self.chi2, self._choice(left)[None], axis=0)[0].sum())
        needed = 0.0 if mine > dof + MISFIT * np.sqrt(2.0 * max(dof, 1.0)) else GAIN
        return mine - theirs - needed

    def hand_over(self, labels: np.ndarray, gone: Sequence[int]) -> None:
        """Give the points, in `labels` (S, B), to the planes that are left."""
        left = [k for k, r in enumerate(self.others, 1) if r not in gone]
        homes = np.array([self.own, *self.others])[self._choice(left)]
        labels[self.box][self.mask] = homes[self.mask]

    def _choice(self, left: Sequence[int]) -> np.ndarray:
        """Which of the planes explains every point and those around it best, shape (s, b)."""
        around = [uniform_filter(self.chi2[k], AROUND, mode="constant") for k in left]
        return np.asarray(left)[np.argmin(around, axis=0)]
