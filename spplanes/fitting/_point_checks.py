"""Checks of whole point clouds in one pass each, without temporaries."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import COVARIANCE_TOLERANCE, FloatArray, as_float_array, as_shape
from spplanes._jit import inlined, njit

#: Variances from this on and up to that, m^2, and coordinates up to the root of that, m: products stay within floats.
SMALLEST_VARIANCE, LARGEST_VARIANCE = 1e-30, 1e30


@inlined
def _is_covariance(c, tolerance: float, least: float, most: float) -> bool:
    """Whether a (3, 3) matrix is one: semidefinite where, with the tolerance on its diagonal, all pivots are > 0."""
    scale = 0.0
    for j in range(3):
        for k in range(3):
            if not np.isfinite(c[j, k]):
                return False
            scale = max(scale, abs(c[j, k]))
    if not least <= scale <= most:
        return False
    slack = tolerance * scale
    if max(abs(c[0, 1] - c[1, 0]), abs(c[0, 2] - c[2, 0]), abs(c[1, 2] - c[2, 1])) > slack:
        return False
    a, d, f = c[0, 0] + slack, c[1, 1] + slack, c[2, 2] + slack
    if a <= 0.0:
        return False
    d -= c[0, 1] * c[0, 1] / a
    e = c[1, 2] - c[0, 1] * c[0, 2] / a
    f -= c[0, 2] * c[0, 2] / a
    return d > 0.0 and f > e * e / d


@njit(cache=True)
def _first_bad_covariance(covariances, valid, tolerance: float, least: float, most: float) -> int:
    """Index of the first matrix of a valid point that is no covariance, or -1."""
    for i in range(covariances.shape[0]):
        plain = not valid[i] or _is_plain(covariances, i, least, most)
        if not (plain or _is_covariance(covariances[i], tolerance, least, most)):
            return i
    return -1


@inlined
def _is_plain(covariances, i, least: float, most: float) -> bool:
    """Whether a matrix is clearly a covariance, by products alone: exactly symmetric, minors well above zero."""
    a, b, c = covariances[i, 0, 0], covariances[i, 0, 1], covariances[i, 0, 2]
    d, e, f = covariances[i, 1, 1], covariances[i, 1, 2], covariances[i, 2, 2]
    symmetric = (covariances[i, 1, 0] == b) & (covariances[i, 2, 0] == c) & (covariances[i, 2, 1] == e)
    minor, product = a * d - b * b, a * d
    det = f * minor - a * e * e - c * (c * d - 2.0 * b * e)
    usual = (min(a, d, f) > least) & (max(a, d, f) < most)
    return symmetric & usual & (minor > 1e-9 * product) & (det > 1e-9 * product * f)


def as_points(name: str, value: ArrayLike) -> FloatArray:
    """Return finite points, shape (N, 3), float64, C order."""
    points = _writable(as_shape(name, value, (None, 3), finite=False))
    most = LARGEST_VARIANCE**0.5
    if points.size and not (points.max() <= most and points.min() >= -most):  # NaN, too
        bad = int(np.argmin((np.abs(points) <= most).all(axis=1)))
        wanted = f"coordinates within {most:.0e} m" if np.isfinite(points[bad]).all() else "finite numbers"
        raise ValueError(f"{name}: expected {wanted}, got {points[bad].tolist()} at index {bad}")
    return points


class _Memory:
    """The memory of an array, as one to write to."""

    def __init__(self, array: FloatArray) -> None:
        self.owner = array
        self.__array_interface__ = {**array.__array_interface__, "data": (array.ctypes.data, False)}


def _writable(array: FloatArray) -> FloatArray:
    """The same memory without its write protection: no kernel writes, but numba would compile all of them anew."""
    return array if array.flags.writeable else np.asarray(_Memory(array))


def as_covariances(
    name: str,
    value: ArrayLike,
    shape: tuple[int, ...],
    *,
    valid: np.ndarray | None = None,
    least: float = SMALLEST_VARIANCE,
    most: float = LARGEST_VARIANCE,
) -> FloatArray:
    """Return symmetric positive semidefinite matrices (..., 3, 3); singular is allowed, all zero is not. ``shape`` is
    that of the points, ``valid``, of that shape, tells which are judged, all of them if None. The largest entry of a
    matrix may be from ``least`` to ``most``, m^2."""
    covariances = as_float_array(name, value)
    if covariances.shape != (*shape, 3, 3):
        raise ValueError(f"{name}: expected shape {(*shape, 3, 3)}, one for each point, got {covariances.shape}")
    covariances = _writable(covariances)
    judged = np.ones(shape, dtype=bool) if valid is None else valid
    matrices = covariances.reshape(-1, 3, 3)
    bad = _first_bad_covariance(matrices, judged.ravel(), COVARIANCE_TOLERANCE, least, most)
    if bad >= 0:
        raise ValueError(f"{name}: {_fault_of(matrices[bad], least, most)} at index {bad}")
    return covariances


def _fault_of(matrix: FloatArray, least: float, most: float) -> str:
    if not np.isfinite(matrix).all():
        return "expected finite numbers, got NaN or infinity"
    largest = float(np.abs(matrix).max())
    if largest == 0.0:
        return "expected some uncertainty in every point, got a zero matrix"
    if not least <= largest <= most:
        return f"expected the largest entries in {least:.0e} to {most:.0e} m^2, got {largest:.3g}"
    if np.abs(matrix - matrix.T).max() > COVARIANCE_TOLERANCE * largest:
        return "expected symmetric matrices, got one that differs from its transpose"
    smallest = float(np.linalg.eigvalsh(matrix)[0])
    return f"expected positive semidefinite matrices, got smallest eigenvalue {smallest:.3g}"
