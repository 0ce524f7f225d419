"""Input checks of the factor builders: keys and noise."""

from __future__ import annotations

import numbers

import numpy as np

from spplanes._check import FloatArray, as_covariance


def as_key(name: str, value: object) -> int:
    """Return a GTSAM key (``gtsam.symbol("x", 3)`` or a plain integer)."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or not 0 <= int(value) < 2**64:
        raise ValueError(f"{name}: expected a GTSAM key (an integer such as gtsam.symbol('x', 0)), got {value!r}")
    return int(value)


def as_definite_covariance(name: str, value: object, size: int) -> FloatArray:
    """Return a symmetric positive definite (size, size) covariance; a singular one has no information matrix."""
    matrix = as_covariance(name, value, size)  # type: ignore[arg-type]
    scale = np.sqrt(np.diag(matrix))
    with np.errstate(divide="ignore", invalid="ignore"):
        correlation = matrix / np.outer(scale, scale)
    if not (scale > 0.0).all() or np.linalg.eigvalsh(correlation)[0] < 1e-12:
        raise ValueError(f"{name}: expected a positive definite covariance, got a singular one")
    return matrix
