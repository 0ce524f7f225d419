"""Probabilistic plane fit: a plane and its covariance from points and theirs.

Two methods. ``"ml"`` minimises sum (n.p_i - d)^2 / (n^T C_i n): maximum likelihood for Gaussian points. ``"sp"`` is the
paper's: weighted principal components with weights 1 / trace(C_i)^2, the covariance by the derivative of the plane by
every coordinate.

References:
    Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, section III. Its signs are mended:
    with z + b0 + b1 x + b2 y = 0, (z, theta, psi) = (-b0, arctan b1, -arctan b2).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from spplanes._rows import OK
from spplanes.fitting._groups import FitJob, Method, Robust, fit_groups, group_by_label
from spplanes.moments import PROBLEMS
from spplanes.plane import Plane


def fit_plane(
    points: ArrayLike,
    covariances: ArrayLike | None = None,
    *,
    sigma: float | None = None,
    method: Method = "ml",
    viewpoint: ArrayLike | None = None,
    scan_index: ArrayLike | None = None,
    pose_covariances: ArrayLike | None = None,
    scan_origins: ArrayLike | None = None,
    robust: Robust | None = None,
    outline: bool = False,
    shared_error: bool = True,
) -> Plane:
    """Fit one plane to uncertain points: its frame is at their weighted centre, x and y along the principal axes.

    Args:
        points: shape (N, 3), N >= 3, m.
        covariances: of the points, shape (N, 3, 3), m^2; singular ones are fine, zero ones are not.
        sigma: instead of ``covariances``: standard deviation of every coordinate, m.
        method: ``"ml"``, or ``"sp"`` as in the paper, with weights 1 / trace^2.
        viewpoint: the normal points to it, shape (3,), m; without it d >= 0.
        scan_index: scan of each point, shape (N,), whose pose error its points share.
        pose_covariances: of the scans' pose errors, shape (S, 6, 6), or (6 S, 6 S) where errors of different scans
            are correlated; in (x, y, z, phi, theta, psi) order, m and rad: world-side perturbations
            p' = p + t + phi (z x q) + theta (y x q) + psi (x x q).
        scan_origins: points about which these rotations act, q = p - o, shape (S, 3), m; the world's origin if None.
        robust: ``"tukey"`` for up to 30 % gross outliers, which n_points and chi2 then leave out; only with ``"ml"``.
        outline: give the plane the convex hull of its points as outline, which is what can be drawn of it.
        shared_error: look in the residuals for noise beyond what is stated, and for errors that neighbouring points
            share (`spplanes.fitting.shared_error`), and count both in the covariance; what is stated is a lower bound.
            Only with ``"ml"``, without pose errors and outliers, which show there too. False: they are independent.

    Raises:
        ValueError: fewer than 3 points, coincident or collinear ones, NaN, or what is no covariance.
    """
    poses = scan_index, pose_covariances, scan_origins
    job = FitJob.checked(points, covariances, sigma, method, viewpoint, robust, poses)
    (plane,) = _fitted(job, np.arange(len(job.points)), np.array([0, len(job.points)]), None, shared_error)
    return _outlined(plane, job) if outline else plane


def _outlined(plane: Plane, job: FitJob) -> Plane:
    """The plane with the hull of its points, those left out that a robust fit left out."""
    import shapely  # late: who fits planes without outlines must not wait for GEOS

    points = np.asarray(job.points)
    if job.robust is not None:
        variances = np.einsum("i,nij,j->n", plane.normal, job.covariances, plane.normal)
        misfits = ((points - plane.centre) @ plane.normal) ** 2 / variances
        points = points[np.argsort(misfits, kind="stable")[: plane.n_points]]
    hull = shapely.convex_hull(shapely.multipoints((points - plane.centre) @ plane.frame[:3, :2]))
    return replace(plane, outline=hull)  # type: ignore[arg-type]  # of three points and more: a polygon


def fit_planes(
    points: ArrayLike,
    covariances: ArrayLike | None = None,
    labels: ArrayLike | None = None,
    *,
    sigma: float | None = None,
    method: Method = "ml",
    viewpoint: ArrayLike | None = None,
    scan_index: ArrayLike | None = None,
    pose_covariances: ArrayLike | None = None,
    scan_origins: ArrayLike | None = None,
    robust: Robust | None = None,
    shared_error: bool = True,
) -> list[Plane]:
    """Fit many planes at once, one to the points of each label.

    Args:
        points: shape (N, 3), m.
        covariances: of the points, shape (N, 3, 3), m^2.
        labels: plane of each point, shape (N,), integers; negative ones are left out.
        sigma, method, viewpoint, scan_index, pose_covariances, scan_origins, robust: as in ``fit_plane``.
        shared_error: as in ``fit_plane``; the planes are taken as seen by one sensor, whose error most of them share.

    Returns:
        The planes in ascending order of label, ``np.unique(labels[labels >= 0])``.

    Raises:
        ValueError: as ``fit_plane``; the sentence names the label.
    """
    poses = scan_index, pose_covariances, scan_origins
    job = FitJob.checked(points, covariances, sigma, method, viewpoint, robust, poses)
    names, order, bounds = group_by_label(labels, len(job.points))
    return _fitted(job, order, bounds, names, shared_error)


def _fitted(
    job: FitJob, order: np.ndarray, bounds: np.ndarray, names: np.ndarray | None, shared_error: bool
) -> list[Plane]:
    """A plane for every group of points, as `group_by_label` tells them; a ValueError names the first that is none."""
    fits = fit_groups(job, order, bounds)
    for g in np.flatnonzero(fits.status != OK)[:1]:
        whose = "points" if names is None else f"points of label {names[g]}"
        raise ValueError(f"{whose}: {PROBLEMS[int(fits.status[g])].format(n=fits.counts[g])}")
    if shared_error and job.method == "ml" and not job.robust and job.shared is None:
        from spplanes.fitting.shared_error import shared_error_of  # late: quantiles of scipy, which nothing else needs

        groups, noise = np.full(len(job.points), -1), job.covariances.reshape(-1, 9)
        groups[order] = np.repeat(np.arange(len(bounds) - 1), np.diff(bounds))
        found = shared_error_of(job.points, noise, groups, fits.frames, fits.covariances, stated=True)
        fits = replace(fits, covariances=found.covariances)
    return fits.planes()
