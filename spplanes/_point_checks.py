"""Checks of whole point clouds in one pass each, without temporaries."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from spplanes._check import COVARIANCE_TOLERANCE, FloatArray, as_float_array

_GOOD, _NOT_FINITE, _ASYMMETRIC, _INDEFINITE, _ZERO = 0, 1, 2, 3, 4


@njit(cache=True)
def _first_not_finite(points) -> int:
    """Index of the first point that is not finite, or -1."""
    for i in range(points.shape[0]):
        if not (np.isfinite(points[i, 0]) and np.isfinite(points[i, 1]) and np.isfinite(points[i, 2])):
            return i
    return -1


@njit(cache=True)
def _judge(c, tolerance: float) -> int:
    """What a (3, 3) matrix is. Semidefinite up to the tolerance: with that much on its diagonal all pivots are > 0."""
    scale = 0.0
    for j in range(3):
        for k in range(3):
            if not np.isfinite(c[j, k]):
                return _NOT_FINITE
            scale = max(scale, abs(c[j, k]))
    if scale == 0.0:
        return _ZERO
    slack = tolerance * scale
    if max(abs(c[0, 1] - c[1, 0]), abs(c[0, 2] - c[2, 0]), abs(c[1, 2] - c[2, 1])) > slack:
        return _ASYMMETRIC
    a, d, f = c[0, 0] + slack, c[1, 1] + slack, c[2, 2] + slack
    if a <= 0.0:
        return _INDEFINITE
    d -= c[0, 1] * c[0, 1] / a
    e = c[1, 2] - c[0, 1] * c[0, 2] / a
    f -= c[0, 2] * c[0, 2] / a
    if d <= 0.0 or f <= e * e / d:
        return _INDEFINITE
    return _GOOD


@njit(cache=True)
def _first_bad_covariance(covariances, tolerance: float) -> tuple[int, int]:
    """Index and fault of the first matrix that is no covariance, or (-1, 0)."""
    for i in range(covariances.shape[0]):
        fault = _judge(covariances[i], tolerance)
        if fault != _GOOD:
            return i, fault
    return -1, _GOOD


def as_points(name: str, value: ArrayLike) -> FloatArray:
    """Return finite points, shape (N, 3), float64, C order."""
    points = as_float_array(name, value)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name}: expected shape (N, 3), got {points.shape}")
    bad = _first_not_finite(points)
    if bad >= 0:
        raise ValueError(f"{name}: expected finite numbers, got {points[bad].tolist()} at index {bad}")
    return points


def as_covariances(name: str, value: ArrayLike, n: int) -> FloatArray:
    """Return (n, 3, 3) symmetric positive semidefinite matrices; singular is allowed, all zero is not."""
    covariances = as_float_array(name, value)
    if covariances.shape != (n, 3, 3):
        raise ValueError(f"{name}: expected shape ({n}, 3, 3), one for each point, got {covariances.shape}")
    bad, fault = _first_bad_covariance(covariances, COVARIANCE_TOLERANCE)
    if bad >= 0:
        raise ValueError(f"{name}: {_describe(fault, covariances[bad])} at index {bad}")
    return covariances


def _describe(fault: int, matrix: FloatArray) -> str:
    if fault == _NOT_FINITE:
        return "expected finite numbers, got NaN or infinity"
    if fault == _ASYMMETRIC:
        return "expected symmetric matrices, got one that differs from its transpose"
    if fault == _ZERO:
        return "expected some uncertainty in every point, got a zero matrix"
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    return f"expected positive semidefinite matrices, got smallest eigenvalue {smallest:.3g}"
