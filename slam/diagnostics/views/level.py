"""What level lasers saw from a keyframe, in their body's plane of motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from slam.diagnostics.views.comparing import one_of_each_cell
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy import free_standing
from spplanes._check import FloatArray

#: Between beams further apart than this nothing is known to be free, rad: a few steps of a laser of 0.5 or 1 deg.
_GAP_RAD = np.deg2rad(2.2)


@dataclass(frozen=True, eq=False)
class View:
    """The returns of one keyframe in its body's plane of motion, to be asked what they say of places about it."""

    fans: tuple[tuple[FloatArray, FloatArray, FloatArray], ...]
    """Of every laser its place (2,), bearings (B,) ascending, rad, and ranges (B,), m."""
    tree: KDTree
    """The returns."""
    looks: FloatArray
    """One return in every square, shape (N, 2), m; of nothing that stands free, for that may be gone for others."""

    @classmethod
    def of(cls, beams: FloatArray) -> View:
        """From beams (B, 4) as rows (x0, y0, x1, y1), m."""
        origins, of_origin = np.unique(beams[:, :2], axis=0, return_inverse=True)
        fans, fixed = [], np.ones(len(beams), dtype=bool)
        for number, origin in enumerate(origins):
            rows = np.flatnonzero(of_origin.ravel() == number)
            away = beams[rows, 2:] - origin
            bearings = np.arctan2(away[:, 1], away[:, 0])
            order = np.argsort(bearings, kind="stable")
            fans.append((origin, bearings[order], np.linalg.norm(away, axis=1)[order]))
            step = float(np.median(np.diff(bearings[order]))) if len(order) > 1 else 1.0
            fixed[rows[order]] = free_standing(away[order], step) < 0
        ends = beams[fixed, 2:]
        return cls(tuple(fans), KDTree(beams[:, 2:]), ends[one_of_each_cell(ends)])

    def looks_of(self, other: View, here_T_other: FloatArray) -> FloatArray:
        """Another view's looks as seen from here, shape (N, 2)."""
        return other.looks @ here_T_other[:2, :2].T + here_T_other[:2, 3]

    def confirms(self, places: FloatArray, tolerance_m: float) -> np.ndarray:
        """Which places (N, 2) have a return within the tolerance, shape (N,)."""
        return np.isfinite(self.tree.query(places, distance_upper_bound=tolerance_m)[0])

    def sees_through(self, places: FloatArray, tolerance_m: float) -> np.ndarray:
        """Which places (N, 2) lie in front of what both beams beside them met, by more than the tolerance, (N,)."""
        through = np.zeros(len(places), dtype=bool)
        for origin, bearings, ranges in self.fans:
            if len(bearings) < 2:
                continue
            away = places - origin
            bearing = np.arctan2(away[:, 1], away[:, 0])
            after = np.clip(np.searchsorted(bearings, bearing), 1, len(bearings) - 1)
            low, high = bearings[after - 1], bearings[after]
            between = (high - low < _GAP_RAD) & (bearing >= low) & (bearing <= high)
            free_m = np.minimum(ranges[after], ranges[after - 1]) - tolerance_m
            through |= between & (np.linalg.norm(away, axis=1) < free_m)
        return through


def views_of(keyframes: Sequence[Keyframe]) -> dict[int, View]:
    """The views of the keyframes that level lasers saw something from."""
    return {
        index: View.of(keyframe.returns)
        for index, keyframe in enumerate(keyframes)
        if keyframe.returns is not None and len(keyframe.returns)
    }
