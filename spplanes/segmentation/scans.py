"""The public entry: planes of an organised grid of points."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from spplanes._check import COVARIANCE_TOLERANCE, FloatArray, as_float_array, as_positive, as_shape
from spplanes.plane import Plane
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.pipeline import segment_sheet
from spplanes.segmentation.planes import planes_of, shared_by_scan
from spplanes.segmentation.sheet import Sheet, number_by_first_point

#: Coordinates beyond this are nobody's measurement, and their squares come to nothing, m.
FARTHEST_M = 1e12
#: Noise below this makes weights that no arithmetic survives, m.
LEAST_SIGMA_M = 1e-9
_DEFAULT = MapperConfig()


def segment_scans(
    points: ArrayLike,
    covariances: ArrayLike | None = None,
    *,
    sigma: ArrayLike | None = None,
    config: MapperConfig = _DEFAULT,
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
    grid, valid = as_grid(points)
    variance = as_variances(valid, covariances, sigma)
    views = None if viewpoints is None else _per_scan("viewpoints", viewpoints, len(grid))
    if not valid.any():
        return np.full(valid.shape, -1, dtype=np.int32), []
    poses, total, shared = None, variance, np.zeros((1, 1, 1))
    if pose_covariances is not None:
        origins = (
            np.zeros((len(grid), 3)) if scan_origins is None else _per_scan("scan_origins", scan_origins, len(grid))
        )
        poses = as_covariances("pose_covariances", pose_covariances, (len(grid), 6, 6)), origins
        shared = shared_by_scan(grid, *poses)
        total = shared + (variance if variance.shape[2] == 9 else variance * np.eye(3).reshape(9))
    eyes = np.zeros((len(grid), 3)) if views is None else views
    sheet = Sheet(grid, total, shared, valid, np.full(valid.shape, -1, dtype=np.int64))
    segment_sheet(sheet, eyes, config)
    labels, _ = number_by_first_point(sheet.labels, len(sheet.rows))
    return labels.astype(np.int32), planes_of(grid, variance, labels, views, poses, config)


def as_grid(points: ArrayLike) -> tuple[FloatArray, np.ndarray]:
    """Points (S, B, 3) with zeros for no return, and which are returns, (S, B)."""
    try:
        grid = np.array(points, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise ValueError("points: expected scans of equal length, shape (S, B, 3), of numbers") from error
    if grid.ndim != 3 or grid.shape[2] != 3:
        raise ValueError(f"points: expected shape (S, B, 3), got {grid.shape}")
    valid = np.asarray(np.isfinite(grid).all(axis=2))
    grid[~valid] = 0.0
    check_near(grid)
    return grid, valid


def check_near(points: FloatArray) -> None:
    """Raise where a coordinate is too large to be squared."""
    largest = max(points.max(initial=0.0), -points.min(initial=0.0))
    if largest > FARTHEST_M:
        raise ValueError(f"points: expected coordinates up to {FARTHEST_M:g} m, got {largest:g} m")


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
        return np.full((*valid.shape, 1), sure**2)
    spread = as_shape("sigma", sigma, valid.shape, finite=False)  # type: ignore[arg-type]
    if not (spread[valid] >= LEAST_SIGMA_M).all() or not np.isfinite(spread[valid]).all():
        expected = f"positive finite numbers of {LEAST_SIGMA_M:g} m or more where there is a point"
        raise ValueError(f"sigma: expected {expected}, got others")
    return np.where(valid, spread, 1.0)[..., None] ** 2


def as_noise(name: str, value: ArrayLike, valid: np.ndarray) -> FloatArray:
    """Covariances of points (S, B, 3, 3), (S, B) that of `valid`: singular ones are fine, zero ones are not."""
    array = as_covariances(name, value, (*valid.shape, 3, 3), valid)
    total = array[..., 0, 0] + array[..., 1, 1] + array[..., 2, 2]
    low, high = total.min(initial=1.0), total.max(initial=1.0)
    if low < LEAST_SIGMA_M**2 or high > FARTHEST_M**2:
        wanted = f"traces from {LEAST_SIGMA_M**2:g} to {FARTHEST_M**2:g} m^2"
        raise ValueError(f"{name}: expected {wanted}, got {low if low < LEAST_SIGMA_M**2 else high:g} m^2")
    return array


def as_covariances(name: str, value: ArrayLike, shape: tuple[int, ...], valid: np.ndarray | None = None) -> FloatArray:
    """Symmetric positive semidefinite matrices of the given shape; those that are not valid become identities."""
    array = as_float_array(name, value)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    if valid is not None and not valid.all():
        array = np.where(valid[..., None, None], array, np.eye(shape[-1]))
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    if not are_semidefinite(array.reshape(-1, shape[-1], shape[-1]), COVARIANCE_TOLERANCE):
        raise ValueError(f"{name}: expected symmetric positive semidefinite covariances, got one that is not")
    return array


def are_semidefinite(matrices: FloatArray, tolerance: float) -> bool:
    """Whether all matrices (N, n, n) are symmetric and positive semidefinite, in ratio to their largest entries."""
    if matrices.shape[1] == 3:
        return bool(_are_semidefinite_3(matrices, tolerance))
    scale = np.abs(matrices).max(axis=(1, 2))
    skewed = np.abs(matrices - matrices.transpose(0, 2, 1)).max(axis=(1, 2)) > tolerance * scale
    return not (skewed.any() or (np.linalg.eigvalsh(matrices)[:, 0] < -tolerance * scale).any())


@njit(cache=True)
def _are_semidefinite_3(matrices, tolerance):
    """By the signs of all principal minors, without eigenvalues."""
    for m in matrices:
        a, d, f = m[0, 0], m[1, 1], m[2, 2]
        b, c, e = m[0, 1], m[0, 2], m[1, 2]
        s = max(abs(a), abs(d), abs(f), abs(b), abs(c), abs(e))
        skew = max(abs(b - m[1, 0]), abs(c - m[2, 0]), abs(e - m[2, 1]))
        minor = min(a * d - b * b, a * f - c * c, d * f - e * e)
        det = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
        if skew > tolerance * s or min(a, d, f) < -tolerance * s:
            return False
        if minor < -tolerance * s * s or det < -tolerance * s * s * s:
            return False
    return True


def _per_scan(name: str, value: ArrayLike, n_scans: int) -> FloatArray:
    """One point per scan, (S, 3), from one (3,) or from (S, 3)."""
    array = as_float_array(name, value)
    if array.shape == (3,):
        array = np.broadcast_to(array, (n_scans, 3))
    return as_shape(name, array, (n_scans, 3))
