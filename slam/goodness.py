"""Is it one plane, seen properly? Tests on a fit before its covariance is believed."""

from __future__ import annotations

import numpy as np

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
    residuals = np.asarray(plane.distance(points))
    variances = np.einsum("i,nij,j->n", plane.normal, covariances, plane.normal)
    variances = np.maximum(variances, 1e-12)
    if scan_index is not None:
        residuals = residuals - _group_means(residuals, scan_index)[scan_index]
    cells = np.floor((points - plane.centre) @ plane.frame[:3, :2] / rules.patch_m).astype(np.int64)
    squares = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    strips = [np.unique(column, return_inverse=True)[1] for column in cells.T]
    return any(_is_uneven(residuals, variances, group, rules, drift_m) for group in (squares, *strips))


def _is_uneven(
    residuals: FloatArray,
    variances: FloatArray,
    group: np.ndarray,
    rules: MeasurementConfig,
    drift_m: FloatArray | None,
) -> bool:
    """Whether the mean residual of some group of points is more than noise, drift and unevenness."""
    weights = np.bincount(group, 1.0 / variances)
    means = np.bincount(group, residuals / variances) / weights
    spread = 1.0 / weights
    if drift_m is not None:
        spread = spread + np.bincount(group, drift_m**2 / variances) / weights  # weighted as the mean it shifts
    return bool((np.abs(means) > np.maximum(rules.step_sigmas * np.sqrt(spread), rules.step_m)).any())


def _group_means(values: FloatArray, group: np.ndarray) -> FloatArray:
    return np.bincount(group, values) / np.maximum(np.bincount(group), 1)
