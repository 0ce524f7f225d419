"""Weighted moments of points that merge in constant time, as a value type and as rows for numba kernels.

Layout of a row, float64, shape (11,), shared by every kernel of this module::

    0  n               number of points
    1  W               sum of the weights
    2  cx, cy, cz      weighted centre, m
    5  Sxx, Sxy, Sxz,  scatter about the centre, sum of w (p - c)(p - c)^T
    8  Syy, Syz, Szz

A row of zeros is the empty set, the neutral element of ``merge_rows``. Callable from ``@njit`` code:

- ``add_point(row, p, w)``: in place;
- ``merge_rows(a, b, out)``: ``out`` may be ``a`` or ``b``;
- ``points_row(points, weights, row)``: a whole array of at least one point at once;
- ``smallest_eigen(row) -> (value, nx, ny, nz)``: mean square distance is value / W; with inverse-variance weights the
  value is the chi2 of the fit;
- ``row_frame(row, viewpoint, frame, values) -> status``: plane frame and all eigenvalues; 0 = OK.

Coordinates are centred before they are squared, so the moments are as good 1,000 km from the origin as at it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spplanes import _rows
from spplanes._check import FloatArray, as_shape, as_weights, check_instance
from spplanes._rows import NO_VIEWPOINT, ROW_SIZE, add_point, merge_rows, points_row, row_frame, smallest_eigen
from spplanes.plane import Plane

__all__ = ["ROW_SIZE", "Moments", "add_point", "merge_rows", "points_row", "row_frame", "smallest_eigen"]


#: What was expected and what came, for an outcome that is no plane.
PROBLEMS = {
    _rows.TOO_FEW: "expected at least 3 points, got {n}",
    _rows.COINCIDENT: "expected points that span a plane, got {n} coincident ones",
    _rows.COLLINEAR: "expected points that span a plane, got {n} collinear ones",
    _rows.OPEN_POSES: "expected scans whose pose covariances leave the plane of {n} points known, got too large ones",
}


@dataclass(frozen=True, eq=False)
class Moments:
    """Count, weight, weighted centre and scatter of a set of points: all that a plane fit needs of them.

    With weights w_i = 1 / s_i^2, the inverse variances along the normal, the scatter's smallest eigenvalue is the chi2
    of the fit, and the SP covariance is A^-1, A = sum w h h^T, h = (1, x, y).
    """

    n: int
    """Number of points."""
    weight: float
    """Sum of the weights, 1/m^2 for inverse variances."""
    centre: FloatArray
    """Weighted centre, shape (3,), m."""
    scatter: FloatArray
    """Sum of w (p - centre)(p - centre)^T, shape (3, 3)."""

    @classmethod
    def from_points(cls, points: ArrayLike, weights: ArrayLike | None = None) -> Moments:
        """Moments of ``points`` (N, 3), m, with ``weights`` (N,) >= 0, not all zero; ones by default.

        Raises:
            ValueError: no points, NaN or infinity, a negative weight, or all weights zero.
        """
        array = as_shape("points", points, (None, 3))
        if len(array) == 0:
            raise ValueError("points: expected at least 1 point, got 0")
        row = np.zeros(ROW_SIZE)
        points_row(array, np.ones(len(array)) if weights is None else as_weights("weights", weights, len(array)), row)
        return cls.from_row(row)

    @classmethod
    def from_row(cls, row: FloatArray) -> Moments:
        """Moments of a kernel row, shape (11,)."""
        row = np.array(row, dtype=np.float64)
        return cls(int(row[0]), float(row[1]), row[2:5], _rows.symmetric3(row[5:]))

    def as_row(self) -> FloatArray:
        """The same as a kernel row, shape (11,)."""
        return np.concatenate(([self.n, self.weight], self.centre, self.scatter[np.triu_indices(3)]))

    def merge(self, other: Moments) -> Moments:
        """Moments of the union of two disjoint sets, in constant time."""
        check_instance("other", other, Moments)
        row = np.empty(ROW_SIZE)
        merge_rows(self.as_row(), other.as_row(), row)
        return Moments.from_row(row)

    __add__ = merge

    def plane(self, viewpoint: ArrayLike | None = None) -> Plane:
        """The plane of these moments, taking the weights as inverse variances along its normal.

        The covariance is A^-1 as the moments give it. It does not know the noise *along* the plane, which ``fit_plane``
        takes out: the difference matters where the patch is hardly wider than that noise.

        Args:
            viewpoint: the normal points to it, shape (3,), m; without it d >= 0.

        Raises:
            ValueError: fewer than 3 points, or coincident or collinear ones.
        """
        eye = NO_VIEWPOINT if viewpoint is None else as_shape("viewpoint", viewpoint, (3,))
        frame, values = np.empty((4, 4)), np.empty(3)
        status = row_frame(self.as_row(), eye, frame, values)
        if status != _rows.OK:
            raise ValueError(f"points: {PROBLEMS[status].format(n=self.n)}")
        covariance = np.diag([1.0 / self.weight, 1.0 / values[2], 1.0 / values[1]])
        return Plane._trusted(frame, covariance, self.n, chi2=float(values[0]))
