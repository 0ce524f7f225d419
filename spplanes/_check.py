"""Input checks of the public boundary: each raises ``ValueError`` with one sentence that names the argument."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from math import isfinite
from numbers import Integral, Real
from operator import index
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]

#: A covariance may be asymmetric, or have a negative eigenvalue, by this share of its largest entry.
COVARIANCE_TOLERANCE = 1e-9
#: Numbers as large as this are no measurements: their products would be infinite before anybody looks.
TOO_LARGE = 1e50


def as_float_array(name: str, value: Any) -> FloatArray:
    """Return ``value`` as a C-ordered float64 array; anything that is not real numbers is a ``ValueError``. Text,
    dates, complex numbers and masked entries are refused, which numpy would turn into floats without a word. What has a
    ``matrix()``, such as a ``gtsam.Pose3``, stands for its matrix, and so does a list of such."""
    if type(value) is np.ndarray and value.dtype == np.float64 and value.flags.c_contiguous:
        return value  # what nearly all callers give
    value = _matrices(value)
    array: np.ndarray | None = None
    try:
        array = np.asarray(value)
        if array.dtype.kind in "cmMSU" or (isinstance(value, np.ma.MaskedArray) and np.ma.getmaskarray(value).any()):
            raise TypeError
        return np.asarray(array, dtype=np.float64, order="C")  # ascontiguousarray would make a scalar (1,)
    except (TypeError, ValueError, OverflowError) as error:
        kind = type(value).__name__ if array is None or array is not value else f"{array.dtype} array"
        if isinstance(value, np.ma.MaskedArray):
            kind = "array with masked entries"
        raise ValueError(f"{name}: expected an array of numbers, got {kind}") from error


def _matrices(value: Any) -> Any:
    """The matrix of a pose, those of a list of poses, anything else as it is."""
    if callable(getattr(value, "matrix", None)):
        return value.matrix()
    if isinstance(value, list | tuple) and value and callable(getattr(value[0], "matrix", None)):
        return [_matrices(one) for one in value]
    return value


def as_shape(name: str, value: Any, shape: tuple[int | None, ...], *, finite: bool = True) -> FloatArray:
    """Return ``value`` as a float64 array of ``shape``, where None stands for any length."""
    array = as_float_array(name, value)
    matches = array.shape == shape or (
        array.ndim == len(shape)
        and all(want is None or want == have for want, have in zip(shape, array.shape, strict=True))
    )
    if not matches:
        wanted = "(" + ", ".join("N" if n is None else str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"
        raise ValueError(f"{name}: expected shape {wanted}, got {array.shape}")
    if finite and array.size and not (array.max() < TOO_LARGE and array.min() > -TOO_LARGE):  # false for NaN, too
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite numbers, got NaN or infinity")
        raise ValueError(f"{name}: expected numbers below {TOO_LARGE:g}, got {float(np.abs(array).max()):.3g}")
    return array


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """The same numbers, not to be written to through what is returned."""
    view = array.view()
    view.flags.writeable = False
    return view


def as_covariance(name: str, value: ArrayLike, size: int) -> FloatArray:
    """Return a symmetric positive semidefinite (size, size) matrix; singular is allowed."""
    return as_covariance_stack(name, as_shape(name, value, (size, size))[None], size)[0]


def as_covariance_stack(name: str, value: ArrayLike, size: int, count: int | None = None) -> FloatArray:
    """Return symmetric positive semidefinite matrices (S, size, size), singular ones too; S is ``count``, if given."""
    matrices = as_shape(name, value, (count, size, size))
    slack = COVARIANCE_TOLERANCE * np.abs(matrices).max(axis=(1, 2), initial=0.0)
    transposed = matrices.transpose(0, 2, 1)
    if (np.abs(matrices - transposed).max(axis=(1, 2), initial=0.0) > slack).any():
        raise ValueError(f"{name}: expected a symmetric covariance, got one that differs from its transpose")
    matrices = 0.5 * (matrices + transposed)
    smallest = np.linalg.eigvalsh(matrices)[:, 0]
    if (smallest < -slack).any():
        got = f"smallest eigenvalue {smallest.min():.3g}"
        raise ValueError(f"{name}: expected a positive semidefinite covariance, got {got}")
    return matrices


def as_transform(name: str, value: Any) -> FloatArray:
    """Return a (4, 4) rigid transform; the rotation part must be orthonormal and right-handed to 1e-6."""
    transform = as_shape(name, value, (4, 4))
    r = transform.tolist()
    if abs(r[3][0]) > 1e-9 or abs(r[3][1]) > 1e-9 or abs(r[3][2]) > 1e-9 or abs(r[3][3] - 1.0) > 1e-9 + 1e-5:
        raise ValueError(f"{name}: expected the last row (0, 0, 0, 1), got {r[3]}")
    if not _is_rotation(r):
        raise ValueError(f"{name}: expected a right-handed rotation in the upper left (3, 3) block")
    return transform


def _is_rotation(rows: list[list[float]]) -> bool:
    """Whether the upper left (3, 3) block is orthonormal and right-handed; in scalars, for every plane is checked."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = rows
    squares = (a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + i * i)
    products = (a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i)
    return (
        all(abs(square - 1.0) <= 1e-6 + 1e-5 for square in squares)
        and all(abs(product) <= 1e-6 for product in products)
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
    )


def as_number(name: str, value: Any, *, finite: bool = True) -> float:
    """Return ``value`` as a float: a Python or numpy number, or an array of shape ()."""
    if type(value) is float:
        number = value
    else:
        is_number = isinstance(value, Real) or (isinstance(value, np.ndarray) and value.ndim == 0)
        if not is_number or isinstance(value, bool | np.bool_):
            raise ValueError(f"{name}: expected a number, got {_told(value)}")
        number = float(as_float_array(name, np.asarray(value)))
    if finite and not abs(number) < TOO_LARGE:
        kind = "a finite number" if not isfinite(number) else f"a number below {TOO_LARGE:g}"
        raise ValueError(f"{name}: expected {kind}, got {number}")
    return number


def as_count(name: str, value: object) -> int:
    """Return ``value`` as a whole number >= 0."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 0:
        raise ValueError(f"{name}: expected a whole number >= 0, got {_told(value)}")
    return int(value)


def check_instance(name: str, value: object, kind: type) -> None:
    """Refuse what is no ``kind``."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIO" else "a"
        raise ValueError(f"{name}: expected {article} {kind.__name__}, got {type(value).__name__}")


def _told(value: object) -> str:
    """A value in one line of a sentence."""
    return " ".join(reprlib.repr(value).split())


def as_positive(name: str, value: float) -> float:
    """Return ``value`` as a finite float above zero."""
    number = as_number(name, value, finite=False)
    if not (isfinite(number) and number > 0.0):
        raise ValueError(f"{name}: expected a positive finite number, got {value}")
    if not 1.0 / TOO_LARGE < number < TOO_LARGE:
        raise ValueError(f"{name}: expected a number from {1.0 / TOO_LARGE:g} to {TOO_LARGE:g}, got {value}")
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
    try:
        rows = tuple(index(row) for row in value)
    except TypeError as error:
        raise ValueError(f"{name}: expected ascending, distinct rows out of 0..5, got {_told(value)}") from error
    if not rows or list(rows) != sorted(set(rows)) or rows[0] < 0 or rows[-1] > 5:
        raise ValueError(f"{name}: expected ascending, distinct rows out of 0..5, got {rows}")
    return rows
