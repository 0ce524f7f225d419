"""Probabilistic plane fit: a plane and its covariance from points and theirs.

Two methods. ``"ml"`` minimises sum (n.p_i - d)^2 / (n^T C_i n): maximum likelihood for Gaussian points. ``"sp"`` is the
paper's: weighted principal components with weights 1 / trace(C_i)^2, the covariance by the derivative of the plane by
every coordinate.

References:
    Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, section III. Its signs are mended:
    with z + b0 + b1 x + b2 y = 0, (z, theta, psi) = (-b0, arctan b1, -arctan b2).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from spplanes import _fit_kernels as kernels
from spplanes._check import FloatArray, as_positive, as_shape
from spplanes._point_checks import as_covariances, as_points
from spplanes._rows import OK
from spplanes.moments import NO_VIEWPOINT, describe_status
from spplanes.plane import Plane

Method = Literal["ml", "sp"]
METHODS: tuple[Method, ...] = ("ml", "sp")


def fit_plane(
    points: ArrayLike,
    covariances: ArrayLike | None = None,
    *,
    sigma: float | None = None,
    method: Method = "ml",
    viewpoint: ArrayLike | None = None,
) -> Plane:
    """Fit one plane to uncertain points.

    Args:
        points: shape (N, 3), N >= 3, m.
        covariances: of the points, shape (N, 3, 3), m^2; singular ones are fine.
        sigma: instead of ``covariances``: standard deviation of every coordinate, m.
        method: ``"ml"`` or ``"sp"``.
        viewpoint: the normal points to it, shape (3,), m; without it d >= 0.

    Returns:
        The plane, its frame at the weighted centre, x and y along the principal axes.

    Raises:
        ValueError: fewer than 3 points, coincident or collinear ones, NaN, or what is no covariance.
    """
    job = _Job.checked(points, covariances, sigma, method, viewpoint)
    order = np.arange(len(job.points))
    fits = _Fits.of_groups(job, order, np.array([0, len(order)]))
    if fits.status[0] != OK:
        raise ValueError("points: " + describe_status(int(fits.status[0]), len(order)))
    return fits.planes()[0]


def fit_planes(
    points: ArrayLike,
    covariances: ArrayLike | None = None,
    labels: ArrayLike | None = None,
    *,
    sigma: float | None = None,
    method: Method = "ml",
    viewpoint: ArrayLike | None = None,
) -> list[Plane]:
    """Fit many planes at once, one to the points of each label.

    Args:
        points: shape (N, 3), m.
        covariances: of the points, shape (N, 3, 3), m^2.
        labels: plane of each point, shape (N,), integers; negative ones are left out.
        sigma: instead of ``covariances``: standard deviation of every coordinate, m.
        method: ``"ml"`` or ``"sp"``.
        viewpoint: the normals point to it, shape (3,), m; without it d >= 0.

    Returns:
        The planes in ascending order of label, ``np.unique(labels[labels >= 0])``.

    Raises:
        ValueError: as ``fit_plane``; the sentence names the label.
    """
    job = _Job.checked(points, covariances, sigma, method, viewpoint)
    names, order, bounds = group_by_label(labels, len(job.points))
    fits = _Fits.of_groups(job, order, bounds)
    bad = np.flatnonzero(fits.status != OK)
    if len(bad):
        n = int(bounds[bad[0] + 1] - bounds[bad[0]])
        raise ValueError(f"points of label {names[bad[0]]}: " + describe_status(int(fits.status[bad[0]]), n))
    return fits.planes()


@dataclass(frozen=True, eq=False)
class _Job:
    """Checked input of a fit."""

    points: FloatArray
    """Shape (N, 3), m."""
    covariances: FloatArray
    """Shape (N, 3, 3), or (1, 3, 3) when all points share one, m^2."""
    step: int
    """Distance between the covariances of successive points: 0 when they share one."""
    viewpoint: FloatArray
    """Shape (3,), m; NaN for none."""
    method: Method
    """How to fit."""

    @classmethod
    def checked(
        cls,
        points: ArrayLike,
        covariances: ArrayLike | None,
        sigma: float | None,
        method: Method,
        viewpoint: ArrayLike | None,
    ) -> _Job:
        """Check what the caller gave, once."""
        if method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, got {method!r}")
        if (covariances is None) == (sigma is None):
            raise ValueError(
                "covariances, sigma: expected exactly one of them, got " + ("none" if sigma is None else "both")
            )
        array = as_points("points", points)
        eye = NO_VIEWPOINT if viewpoint is None else as_shape("viewpoint", viewpoint, (3,))
        if covariances is not None:
            return cls(array, as_covariances("covariances", covariances, len(array)), 1, eye, method)
        assert_sigma = as_positive("sigma", sigma)  # type: ignore[arg-type]
        return cls(array, assert_sigma**2 * np.eye(3)[None], 0, eye, method)


@dataclass(frozen=True, eq=False)
class _Fits:
    """Outcome of a fit for every group."""

    status: np.ndarray
    """Shape (P,), OK or why not."""
    frames: FloatArray
    """Shape (P, 4, 4)."""
    covariances: FloatArray
    """Shape (P, 3, 3)."""
    counts: np.ndarray
    """Points used, shape (P,)."""
    chi2: FloatArray
    """Shape (P,)."""

    @classmethod
    def of_groups(cls, job: _Job, order: np.ndarray, bounds: np.ndarray) -> _Fits:
        """Fit every group ``order[bounds[g]:bounds[g + 1]]``."""
        n = len(bounds) - 1
        fits = cls(np.empty(n, np.int64), np.empty((n, 4, 4)), np.empty((n, 3, 3)), np.empty(n, np.int64), np.empty(n))
        _fit_groups(
            job.points, job.covariances, job.step, order, bounds, job.viewpoint, job.method == "sp",
            fits.status, fits.frames, fits.covariances, fits.counts, fits.chi2,
        )  # fmt: skip
        return fits

    def planes(self) -> list[Plane]:
        """One plane a group."""
        rows = zip(self.frames, self.covariances, self.counts.tolist(), self.chi2.tolist(), strict=True)
        return [Plane._trusted(frame, covariance, n, None, chi2) for frame, covariance, n, chi2 in rows]


@njit(cache=True)
def _fit_groups(points, covs, step, order, bounds, viewpoint, paper, status, frames, covariances, counts, chi2) -> None:
    """Fit group after group."""
    sums = np.zeros(kernels.N_SUMS)
    for g in range(bounds.shape[0] - 1):
        lo, hi = bounds[g], bounds[g + 1]
        counts[g] = hi - lo
        if paper:
            status[g], chi2[g] = kernels.sp_group(
                points, covs, step, order, lo, hi, viewpoint, frames[g], covariances[g]
            )
        else:
            status[g] = kernels.ml_group(points, covs, step, order, lo, hi, viewpoint, frames[g], covariances[g], sums)
            chi2[g] = sums[kernels.CHI2]


def group_by_label(labels: ArrayLike | None, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct labels >= 0 ascending (P,), indices sorted by label, stable, and the groups' bounds (P + 1,)."""
    array = np.asarray(labels)
    if array.shape != (n,) or array.dtype.kind not in "iu":
        raise ValueError(f"labels: expected {n} integers, one for each point, got {array.dtype} of shape {array.shape}")
    order = np.argsort(array, kind="stable")
    order = order[np.searchsorted(array[order], 0) :]
    ranked = array[order]
    starts = np.flatnonzero(np.diff(ranked, prepend=-1))
    return ranked[starts], order, np.append(starts, len(order))
