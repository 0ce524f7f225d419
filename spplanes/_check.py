"""Input checks of the public boundary: each raises ``ValueError`` with one sentence that names the argument."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

#: A covariance may be asymmetric, or have a negative eigenvalue, by this share of its largest entry.
COVARIANCE_TOLERANCE = 1e-9


def as_float_array(name: str, value: ArrayLike) -> FloatArray:
    """Return ``value`` as a C-ordered float64 array; anything that is not numeric is a ``ValueError``."""
    try:
        return np.asarray(value, dtype=np.float64, order="C")  # ascontiguousarray would make a scalar (1,)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected an array of numbers, got {type(value).__name__}") from error


def as_shape(name: str, value: ArrayLike, shape: tuple[int | None, ...], *, finite: bool = True) -> FloatArray:
    """Return ``value`` as a float64 array of ``shape``, where None stands for any length."""
    array = as_float_array(name, value)
    matches = array.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, array.shape, strict=True)
    )
    if not matches:
        wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}")
    if finite and not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
    return array


def as_covariance(name: str, value: ArrayLike, size: int) -> FloatArray:
    """Return a symmetric positive semidefinite (size, size) matrix; singular is allowed."""
    return as_covariance_stack(name, as_shape(name, value, (size, size))[None], size)[0]


def as_covariance_stack(name: str, value: ArrayLike, size: int) -> FloatArray:
    """Return symmetric positive semidefinite matrices, shape (S, size, size); singular is allowed."""
    matrices = as_shape(name, value, (None, size, size))
    slack = COVARIANCE_TOLERANCE * np.abs(matrices).max(axis=(1, 2), initial=0.0)
    transposed = matrices.transpose(0, 2, 1)
    if (np.abs(matrices - transposed).max(axis=(1, 2), initial=0.0) > slack).any():
        raise ValueError(f"{name}: expected a symmetric covariance, got one that differs from its transpose")
    matrices = 0.5 * (matrices + transposed)
    smallest = np.linalg.eigvalsh(matrices)[:, 0]
    if (smallest < -slack).any():
        raise ValueError(
            f"{name}: expected a positive semidefinite covariance, got smallest eigenvalue {smallest.min():.3g}"
        )
    return matrices


def as_transform(name: str, value: ArrayLike) -> FloatArray:
    """Return a (4, 4) rigid transform; the rotation part must be orthonormal and right-handed to 1e-6."""
    transform = as_shape(name, value, (4, 4))
    rotation = transform[:3, :3]
    if not np.allclose(transform[3], (0.0, 0.0, 0.0, 1.0), atol=1e-9):
        raise ValueError(f"{name}: expected the last row (0, 0, 0, 1), got {transform[3].tolist()}")
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0.0:
        raise ValueError(f"{name}: expected a right-handed rotation in the upper left (3, 3) block")
    return transform


def as_positive(name: str, value: float) -> float:
    """Return ``value`` as a finite float above zero."""
    number = float(value)
    if not (np.isfinite(number) and number > 0.0):
        raise ValueError(f"{name}: expected a positive finite number, got {value}")
    return number


def as_weights(name: str, value: ArrayLike, size: int) -> FloatArray:
    """Return (size,) weights: finite, none negative, not all zero."""
    weights = as_shape(name, value, (size,))
    if (weights < 0.0).any():
        raise ValueError(f"{name}: expected no negative weight, got {weights.min():.3g}")
    if not weights.any():
        raise ValueError(f"{name}: expected at least one positive weight, got only zeros")
    return weights


def as_rows(name: str, value: Sequence[int]) -> tuple[int, ...]:
    """Return binding rows: ascending, distinct, out of 0..5, at least one."""
    rows = tuple(int(row) for row in value)
    if not rows or list(rows) != sorted(set(rows)) or rows[0] < 0 or rows[-1] > 5:
        raise ValueError(f"{name}: expected ascending, distinct rows out of 0..5, got {rows}")
    return rows
