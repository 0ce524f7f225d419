"""Is it one plane, seen properly? Tests on a fit before its covariance is believed."""

from __future__ import annotations

import numpy as np

from slam._patch_kernels import along_normal, numbered, patches_of, strays
from slam.config import MeasurementConfig
from spplanes import Plane
from spplanes._check import FloatArray


def is_one_plane(
    plane: Plane,
    points: FloatArray,
    covariances: FloatArray,
    viewpoint: FloatArray,
    rules: MeasurementConfig,
    scan_index: np.ndarray | None = None,
    drift_m: FloatArray | None = None,
) -> bool:
    """Whether points (N, 3) with covariances (N, 3, 3) lie about the plane as their noise says, patch by patch too.

    Args:
        plane: the fit.
        points, covariances: what it was fitted to.
        viewpoint: where it was seen from, shape (3,).
        rules: how much is allowed.
        scan_index: scan of every point, shape (N,), where the points of a scan share a pose error.
        drift_m: standard deviation of what a slow error of the sensor shifts every point by, shape (N,), m.
    """
    return (
        could_be_seen(plane, viewpoint, rules)
        and fits_its_noise(plane, rules)
        and not has_step(plane, points, covariances, rules, scan_index, drift_m)
    )


def could_be_seen(plane: Plane, viewpoint: FloatArray, rules: MeasurementConfig) -> bool:
    """Whether the plane is seen less edge-on than `max_incidence_rad` from the middle of its points."""
    away = float(np.linalg.norm(plane.centre - viewpoint))
    return abs(float(plane.distance(viewpoint))) >= away * np.cos(rules.max_incidence_rad)


def fits_its_noise(plane: Plane, rules: MeasurementConfig) -> bool:
    """Whether chi2 of the fit is what it should be, up to the slack that the noise level is known to."""
    dof = max(plane.n_points - 3, 1)
    return plane.chi2 <= dof * (1.0 + rules.noise_slack) + rules.misfit_sigmas * np.sqrt(2.0 * dof)


def has_step(
    plane: Plane,
    points: FloatArray,
    covariances: FloatArray,
    rules: MeasurementConfig,
    scan_index: np.ndarray | None = None,
    drift_m: FloatArray | None = None,
) -> bool:
    """Whether some patch of the plane lies off it by more than noise and unevenness: two surfaces fitted as one.

    Averages over patches, and over strips right across the plane, see a step of 2 cm in noise of 15 mm long before the
    chi2 of all points does, and hardly mind a noise level that is known to 10 % only. What all points of a scan share,
    its pose error, is taken out first.
    """
    residuals, variances = along_normal(points, covariances, plane.frame)
    variances = np.maximum(variances, 1e-12)
    if scan_index is not None:
        residuals = residuals - _group_means(residuals, scan_index)[scan_index]
    row, column, n_rows, n_columns = patches_of(points, plane.frame, rules.patch_m)
    drift = np.empty(0) if drift_m is None else drift_m**2
    groups = (row * n_columns + column, n_rows * n_columns), (row, n_rows), (column, n_columns)
    return any(
        strays(residuals, variances, drift, *numbered(code, span), rules.step_sigmas, rules.step_m).any()
        for code, span in groups
    )


def without_strays(
    plane: Plane,
    points: FloatArray,
    covariances: FloatArray,
    rules: MeasurementConfig,
    drift_m: FloatArray | None = None,
) -> np.ndarray | None:
    """Which points of a plane to keep, shape (N,): those that lie in no patch that strays from it, nor beside one.

    A floor of two thousand patches has one that strays by chance, or for a foot that stands on it: there is something
    else, of which the patches around have their share, and the floor is a plane without it.

    Returns:
        None where no patch strays.
    """
    residuals, variances = along_normal(points, covariances, plane.frame)
    row, column, n_rows, n_columns = patches_of(points, plane.frame, rules.patch_m)
    wide = n_columns + 2  # room for the patches around
    places = (row + 1) * wide + column + 1
    patch, count = numbered(places, (n_rows + 2) * wide)
    drift = np.empty(0) if drift_m is None else drift_m**2
    off = strays(residuals, np.maximum(variances, 1e-12), drift, patch, count, rules.step_sigmas, rules.step_m)[patch]
    around = np.add.outer((-wide, 0, wide), (-1, 0, 1)).ravel()
    left = np.isin(places, np.add.outer(np.unique(places[off]), around))
    return ~left if left.any() else None


def _group_means(values: FloatArray, group: np.ndarray) -> FloatArray:
    return np.bincount(group, values) / np.maximum(np.bincount(group), 1)
