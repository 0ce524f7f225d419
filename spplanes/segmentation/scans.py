"""The public entry: planes of an organised grid of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_covariance_stack, as_float_array, as_positive, as_shape
from spplanes.fitting._point_checks import as_covariances
from spplanes.fitting._pose_error import shared_by_scan
from spplanes.plane import Plane
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.pipeline import segment_sheet
from spplanes.segmentation.planes import planes_of
from spplanes.segmentation.sheet import Sheet, by_first_point, renumbered

DEFAULT = MapperConfig()
#: Coordinates beyond this are nobody's measurement, and their squares come to nothing, m.
FARTHEST_M = 1e12
#: Noise below this makes weights that no arithmetic survives, m.
LEAST_SIGMA_M = 1e-9


def segment_scans(
    points: ArrayLike,
    covariances: ArrayLike | None = None,
    *,
    sigma: ArrayLike | None = None,
    config: MapperConfig = DEFAULT,
    viewpoints: ArrayLike | None = None,
    pose_covariances: ArrayLike | None = None,
    scan_origins: ArrayLike | None = None,
) -> tuple[np.ndarray, list[Plane]]:
    """Planes of S scans (or image rows) of B beams each.

    Args:
        points: shape (S, B, 3), m; a point that is not finite is no return.
        covariances: covariance of every point, shape (S, B, 3, 3), m^2; or
        sigma: isotropic standard deviation, m: one number, or shape (S, B). Exactly one of the two is needed.
        config: settings; the defaults serve every sensor.
        viewpoints: where the points were seen from, (3,) or (S, 3), m: normals point there, and steps in depth are
            told from surfaces seen at a grazing angle. Without them normals are turned so that d >= 0 and depth is
            taken from the origin.
        pose_covariances: shape (S, 6, 6): covariance of the pose error (x, y, z, phi, theta, psi) that all points of
            scan s share, world-side; it is added to the planes, never to the points.
        scan_origins: the points about which those errors turn, (3,) or (S, 3), m; the origin by default.

    Returns:
        labels: shape (S, B), int32, index into planes, -1 = none.
        planes: in the order of their first point.

    Raises:
        ValueError: rows of different length, other shapes, covariances that are not positive semidefinite, noise that
            is not positive, and numbers too large or too small to be squared.

    References:
        Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, section IV.
    """
    found = label_scans(points, covariances, sigma, config, viewpoints, pose_covariances, scan_origins)
    planes = planes_of(found.points, found.covariance, found.labels, found.views, found.poses, config)
    return found.labels.astype(np.int32), planes


@dataclass(frozen=True, eq=False)
class Labelled:
    """A grid of points with the region of each, and what was given with it, checked."""

    points: FloatArray
    """Shape (S, B, 3), m."""
    covariance: FloatArray
    """Of the points, shape (S, B, 1) isotropic or (S, B, 9), m^2."""
    labels: np.ndarray
    """Region of every point, in the order of their first points, shape (S, B), int64, -1 = none."""
    views: FloatArray | None
    """Viewpoint of every row, shape (S, 3), m."""
    poses: tuple[FloatArray, FloatArray] | None
    """Pose covariances (S, 6, 6) and the points they turn about (S, 3)."""


def label_scans(
    points: ArrayLike,
    covariances: ArrayLike | None = None,
    sigma: ArrayLike | None = None,
    config: MapperConfig = DEFAULT,
    viewpoints: ArrayLike | None = None,
    pose_covariances: ArrayLike | None = None,
    scan_origins: ArrayLike | None = None,
) -> Labelled:
    """The regions of `segment_scans`, for those who fit their planes themselves; same arguments, same errors."""
    grid, valid = as_grid(points)
    variance = as_variances(valid, covariances, sigma)
    views = None if viewpoints is None else _per_scan("viewpoints", viewpoints, len(grid))
    if not valid.any():
        return Labelled(grid, variance, np.full(valid.shape, -1), views, None)
    poses, total, shared = None, variance, np.zeros((1, 1, 1))
    if pose_covariances is not None:
        origins = _per_scan("scan_origins", np.zeros(3) if scan_origins is None else scan_origins, len(grid))
        poses = as_covariance_stack("pose_covariances", pose_covariances, 6, len(grid)), origins
        shared = shared_by_scan(grid, *poses)
        total = shared + (variance if variance.shape[2] == 9 else variance * np.eye(3).reshape(9))
    eyes = np.zeros((len(grid), 3)) if views is None else views
    sheet = Sheet(grid, total, shared, valid, np.full(valid.shape, -1, dtype=np.int64))
    segment_sheet(sheet, eyes, config)
    counts = np.bincount(sheet.labels[sheet.labels >= 0], minlength=1)
    kept = np.where(counts[sheet.labels] >= 3, sheet.labels, -1)  # all that borders may leave of a region is no plane
    return Labelled(grid, variance, renumbered(kept, by_first_point(kept), len(sheet.rows)), views, poses)


def as_grid(points: ArrayLike) -> tuple[FloatArray, np.ndarray]:
    """Points (S, B, 3) with zeros for no return, and which are returns, (S, B)."""
    try:
        given = np.asarray(points, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError("points: expected scans of equal length, shape (S, B, 3), of numbers") from error
    if given.ndim != 3 or given.shape[2] != 3:
        raise ValueError(f"points: expected shape (S, B, 3), got {given.shape}")
    finite = np.isfinite(given)
    valid = finite[..., 0] & finite[..., 1] & finite[..., 2]
    grid = np.where(valid[..., None], given, 0.0)
    largest = max(grid.max(initial=0.0), -grid.min(initial=0.0))
    if largest > FARTHEST_M:
        raise ValueError(f"points: expected coordinates up to {FARTHEST_M:g} m, got {largest:g} m")
    return grid, valid


def as_variances(valid: np.ndarray, covariances: ArrayLike | None, sigma: ArrayLike | None) -> FloatArray:
    """Variances of the points: (S, B, 1) isotropic or (S, B, 9); checked where there is a return."""
    if (covariances is None) == (sigma is None):
        raise ValueError("covariances: expected exactly one of covariances and sigma, got both or none")
    if covariances is not None:
        return as_noise("covariances", covariances, valid).reshape(*valid.shape, 9)
    if np.ndim(sigma) == 0:  # type: ignore[arg-type]
        sure = as_positive("sigma", float(sigma))  # type: ignore[arg-type]
        if sure < LEAST_SIGMA_M:
            raise ValueError(f"sigma: expected at least {LEAST_SIGMA_M:g} m, got {sure:g} m")
        if sure > FARTHEST_M:
            raise ValueError(f"sigma: expected at most {FARTHEST_M:g} m, got {sure:g} m")
        return np.full((*valid.shape, 1), sure**2)
    spread = as_shape("sigma", sigma, valid.shape, finite=False)  # type: ignore[arg-type]
    if not (spread[valid] >= LEAST_SIGMA_M).all() or not np.isfinite(spread[valid]).all():
        expected = f"positive finite numbers of {LEAST_SIGMA_M:g} m or more where there is a point"
        raise ValueError(f"sigma: expected {expected}, got others")
    return np.where(valid, spread, 1.0)[..., None] ** 2


def as_noise(name: str, value: ArrayLike, valid: np.ndarray) -> FloatArray:
    """Covariances of points (..., 3, 3), (...) the shape of `valid`: singular ones are fine, zero ones are not.

    What comes for points that are no returns is neither judged nor ever read.
    """
    return as_covariances(name, value, valid.shape, valid=valid, least=LEAST_SIGMA_M**2, most=FARTHEST_M**2)


def _per_scan(name: str, value: ArrayLike, n_scans: int) -> FloatArray:
    """One point per scan, (S, 3), from one (3,) or from (S, 3)."""
    array = as_float_array(name, value)
    if array.shape == (3,):
        array = np.broadcast_to(array, (n_scans, 3))
    return as_shape(name, array, (n_scans, 3))
