"""Validation: is it one plane, seen properly? Tests on a fit before its covariance is believed."""

from __future__ import annotations

from functools import cached_property

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import njit
from spplanes.plane import Plane
from spplanes.segmentation.config import ValidationConfig


def is_one_plane(
    plane: Plane,
    points: FloatArray,
    covariances: FloatArray,
    viewpoint: FloatArray,
    rules: ValidationConfig,
    scan_index: np.ndarray | None = None,
) -> bool:
    """Whether points (N, 3) with covariances (N, 3, 3), what the plane was fitted to, lie about it as their noise says.
    Patch by patch too. `scan_index` (N,) tells which points share the pose error of a scan."""
    return (
        could_be_seen(plane, viewpoint, rules)
        and fits_its_noise(plane, rules)
        and not InPatches(plane, points, covariances, rules, scan_index).has_step
    )


def could_be_seen(plane: Plane, viewpoint: FloatArray, rules: ValidationConfig) -> bool:
    """Whether the plane is seen less edge-on than `max_incidence_rad` from the middle of its points."""
    away = float(np.linalg.norm(plane.centre - viewpoint))
    return abs(float(plane.distance(viewpoint))) >= away * np.cos(rules.max_incidence_rad)


def fits_its_noise(plane: Plane, rules: ValidationConfig) -> bool:
    """Whether chi2 of the fit is what it should be, up to the slack that the noise level is known to."""
    dof = max(plane.n_points - 3, 1)
    return plane.chi2 <= dof * (1.0 + rules.noise_slack) + rules.misfit_sigmas * np.sqrt(2.0 * dof)


class InPatches:
    """How the points of a plane lie about it, patch by patch and strip by strip right across it."""

    def __init__(
        self,
        plane: Plane,
        points: FloatArray,
        covariances: FloatArray,
        rules: ValidationConfig,
        scan_index: np.ndarray | None = None,
        drift_m: FloatArray | None = None,
    ) -> None:
        """For the arguments see `is_one_plane`. What all points of a scan share, its pose error, is taken out.
        `drift_m`: standard deviation of what a slow error of the sensor shifts every point by, shape (N,), m."""
        residuals, variances = along_normal(points, covariances, plane.frame)
        if scan_index is not None:
            means = np.bincount(scan_index, residuals) / np.maximum(np.bincount(scan_index), 1)
            residuals = residuals - means[scan_index]
        self._of_points = (
            residuals,
            np.maximum(variances, 1e-12),
            np.zeros(len(points)) if drift_m is None else drift_m**2,
        )
        self._limits = rules.step_sigmas, rules.step_m
        self._row, self._column, self._n_rows, self._n_columns = patches_of(points, plane.frame, rules.patch_m)
        self._wide = self._n_columns + 2  # room for the patches around
        self._place = (self._row + 1) * self._wide + self._column + 1

    @cached_property
    def has_step(self) -> bool:
        """Whether some patch or strip lies off the plane by more than noise and unevenness: two surfaces as one.
        Averages over patches, and over strips right across the plane, see a step of 2 cm in noise of 15 mm long before
        the chi2 of all points does, and hardly mind a noise level that is known to 10 % only."""
        strips = (self._row, self._n_rows), (self._column, self._n_columns)
        off = (strays(*self._of_points, *numbered(*strip), *self._limits) for strip in strips)
        return bool(self._off.any()) or any(bool(one.any()) for one in off)

    def without_strays(self) -> np.ndarray | None:
        """Which points of the plane to keep, (N,): those that lie in no patch that strays, nor beside one; None where
        none does. A floor of two thousand patches has one that strays by chance, or for a foot that stands on it: there
        is something else, of which the patches around have their share, and the floor is a plane without it."""
        if not self._off.any():
            return None
        around = np.add.outer((-self._wide, 0, self._wide), (-1, 0, 1)).ravel()
        return ~np.isin(self._place, np.add.outer(np.unique(self._place[self._off]), around))

    @cached_property
    def _off(self) -> np.ndarray:
        """Which points lie in a patch that strays, shape (N,)."""
        patch, count = numbered(self._place, (self._n_rows + 2) * self._wide)
        return strays(*self._of_points, patch, count, *self._limits)[patch]


def patches_of(points: FloatArray, frame: FloatArray, side: float) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Row and column (N,) of the square patch of every point, from 0 on, int64, and how many of both there are. The
    origin of the plane's frame is a corner of patches; those further out than 2^29 of their sides, m, are one."""
    x, y, z = (points - frame[:3, 3]).T
    row, column = (
        np.clip(np.floor((x * a + y * b + z * c) / side), -(2.0**29), 2.0**29).astype(np.int64)
        for a, b, c in frame[:3, :2].T
    )
    if len(points) == 0:
        return row, column, 0, 0
    row -= row.min()
    column -= column.min()
    return row, column, int(row.max()) + 1, int(column.max()) + 1


def numbered(codes: np.ndarray, span: int) -> tuple[np.ndarray, int]:
    """A number (N,) for every code from 0 to span - 1, the same for the same code, and how many numbers there are."""
    if span <= 8 * len(codes) + 1024:  # else there is no room for what nothing is in
        return codes, span
    present, number = np.unique(codes, return_inverse=True)
    return number, len(present)


def strays(
    residuals: FloatArray,
    variances: FloatArray,
    drift: FloatArray,
    group: np.ndarray,
    n_groups: int,
    sigmas: float,
    least: float,
) -> np.ndarray:
    """Whether the weighted mean residual of each group (N,) is more than noise, drift and unevenness, shape
    (n_groups,). `residuals` and `variances` are along the plane's normal, m and m^2, `drift` (N,) the
    variance of what a slow error shifts every point by. A mean may be so many `sigmas`, and `least`, m."""
    weights = 1.0 / variances
    total, moments, slow = (
        np.bincount(group, one, n_groups) for one in (weights, weights * residuals, weights * drift)
    )
    there, total = total > 0.0, np.where(total > 0.0, total, 1.0)
    return there & (np.abs(moments / total) > np.maximum(sigmas * np.sqrt((1.0 + slow) / total), least))


@njit(cache=True)
def along_normal(points, covariances, frame):
    """Distances (N,) of points from a plane, m, and their variances, m^2."""
    n = points.shape[0]
    distances, variances = np.empty(n), np.empty(n)
    nx, ny, nz = frame[0, 2], frame[1, 2], frame[2, 2]
    for k in range(n):
        c = covariances[k]
        x, y, z = points[k, 0] - frame[0, 3], points[k, 1] - frame[1, 3], points[k, 2] - frame[2, 3]
        distances[k] = x * nx + y * ny + z * nz
        across = nx * (c[0, 0] * nx + (c[0, 1] + c[1, 0]) * ny + (c[0, 2] + c[2, 0]) * nz)
        across += ny * (c[1, 1] * ny + (c[1, 2] + c[2, 1]) * nz) + nz * c[2, 2] * nz
        variances[k] = across
    return distances, variances
