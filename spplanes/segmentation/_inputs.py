"""The input of a segmentation: organised points and their noise, checked once and in one pass."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import COVARIANCE_TOLERANCE, FloatArray, as_float_array, as_positive, as_shape
from spplanes._jit import njit
from spplanes.fitting._point_checks import writable

#: Coordinates beyond this are nobody's measurement, and their squares come to nothing, m.
FARTHEST_M = 1e12
#: Noise below this makes weights that no arithmetic survives, m.
LEAST_SIGMA_M = 1e-9


def as_grid(points: ArrayLike) -> tuple[FloatArray, np.ndarray]:
    """Points (S, B, 3) with zeros for no return, and which are returns, (S, B)."""
    try:
        given = writable(np.asarray(points, dtype=np.float64, order="C"))
    except (TypeError, ValueError) as error:
        raise ValueError("points: expected scans of equal length, shape (S, B, 3), of numbers") from error
    if given.ndim != 3 or given.shape[2] != 3:
        raise ValueError(f"points: expected shape (S, B, 3), got {given.shape}")
    grid, valid = np.empty(given.shape), np.empty(given.shape[:2], dtype=np.bool_)
    largest = _take(given, grid, valid)
    if largest > FARTHEST_M:
        raise ValueError(f"points: expected coordinates up to {FARTHEST_M:g} m, got {largest:g} m")
    return grid, valid


@njit(cache=True)
def _take(points, grid, valid):
    """Fill in grid and valid; the largest coordinate."""
    largest = 0.0
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            x, y, z = points[i, j, 0], points[i, j, 1], points[i, j, 2]
            valid[i, j] = np.isfinite(x) and np.isfinite(y) and np.isfinite(z)
            if not valid[i, j]:
                x = y = z = 0.0
            grid[i, j, 0], grid[i, j, 1], grid[i, j, 2] = x, y, z
            largest = max(largest, abs(x), abs(y), abs(z))
    return largest


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
    """Covariances of points (S, B, 3, 3), (S, B) that of `valid`: singular ones are fine, zero ones are not.

    What comes for points that are no returns is neither judged nor ever read.
    """
    array, shape = as_float_array(name, value), (*valid.shape, 3, 3)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    array = writable(array)
    faults, low, high = _judge(array.reshape(-1, 9), valid.ravel(), COVARIANCE_TOLERANCE)
    if faults[0]:
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    if faults[1]:
        raise ValueError(f"{name}: expected symmetric positive semidefinite covariances, got one that is not")
    if low < LEAST_SIGMA_M**2 or high > FARTHEST_M**2:
        wanted = f"traces from {LEAST_SIGMA_M**2:g} to {FARTHEST_M**2:g} m^2"
        raise ValueError(f"{name}: expected {wanted}, got {low if low < LEAST_SIGMA_M**2 else high:g} m^2")
    return array


@njit(cache=True)
def _judge(matrices, valid, tolerance):
    """Whether matrices (N, 9) of valid points are not finite, or not semidefinite; their least and largest trace.

    Semidefinite by the signs of all principal minors, without eigenvalues, in ratio to the largest entry.
    """
    infinite, indefinite, low, high = False, False, 1.0, 1.0
    for k in range(matrices.shape[0]):
        if not valid[k]:
            continue
        a, b, c = matrices[k, 0], matrices[k, 1], matrices[k, 2]
        d, e, f = matrices[k, 4], matrices[k, 5], matrices[k, 8]
        below = abs(b - matrices[k, 3]), abs(c - matrices[k, 6]), abs(e - matrices[k, 7])
        infinite |= not np.isfinite(a + b + c + d + e + f + below[0] + below[1] + below[2])
        s = max(abs(a), abs(d), abs(f), abs(b), abs(c), abs(e))
        minor = min(a * d - b * b, a * f - c * c, d * f - e * e)
        det = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
        indefinite |= max(below[0], below[1], below[2]) > tolerance * s or min(a, d, f) < -tolerance * s
        indefinite |= minor < -tolerance * s * s or det < -tolerance * s * s * s
        low, high = min(low, a + d + f), max(high, a + d + f)
    return (infinite, indefinite), low, high
