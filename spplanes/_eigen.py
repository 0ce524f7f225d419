"""3x3 symmetric matrices, numba-callable: eigenvalues by Jacobi rotations, accurate when near-degenerate; solutions."""

from __future__ import annotations

import math

import numpy as np

from spplanes._jit import inlined, inner, njit

_MAX_SWEEPS = 30


@inner(cache=True)
def _rotation(app: float, aqq: float, apq: float) -> tuple[float, float, float]:
    """Tangent, cosine and sine of the Jacobi rotation that zeroes ``apq``, the smaller of the two angles."""
    tau = (aqq - app) / (2.0 * apq)
    t = 1.0 / (abs(tau) + math.sqrt(1.0 + tau * tau))
    if tau < 0.0:
        t = -t
    c = 1.0 / math.sqrt(1.0 + t * t)
    return t, c, t * c


@inlined
def _is_negligible(off: float, a: float, b: float) -> bool:
    """Whether an off-diagonal entry is below the rounding of both its diagonal entries."""
    return abs(off) <= 1e-17 * math.sqrt(abs(a)) * math.sqrt(abs(b)) or abs(off) < 1e-300


@njit(cache=True)
def jacobi3(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, values, vectors) -> None:
    """Eigenvalues, ascending, and eigenvectors of a symmetric 3x3 matrix given by its upper triangle.

    Cyclic Jacobi rotations, written out for the three pairs. A small eigenvalue of a positive semidefinite matrix is
    found to rounding of the matrix' entries, and eigenvectors stay orthogonal to rounding, also when eigenvalues tie.

    Args:
        xx, xy, xz, yy, yz, zz: the entries.
        values: receives the eigenvalues, shape (3,).
        vectors: receives the eigenvectors in its columns, shape (3, 3).
    """
    v = np.zeros((3, 3))
    for k in range(3):
        v[k, k] = 1.0
    for _ in range(_MAX_SWEEPS):
        done = True
        if not _is_negligible(xy, xx, yy):
            done = False
            t, c, s = _rotation(xx, yy, xy)
            xx, yy, xy = xx - t * xy, yy + t * xy, 0.0
            xz, yz = c * xz - s * yz, s * xz + c * yz
            for k in range(3):
                v[k, 0], v[k, 1] = c * v[k, 0] - s * v[k, 1], s * v[k, 0] + c * v[k, 1]
        if not _is_negligible(xz, xx, zz):
            done = False
            t, c, s = _rotation(xx, zz, xz)
            xx, zz, xz = xx - t * xz, zz + t * xz, 0.0
            xy, yz = c * xy - s * yz, s * xy + c * yz
            for k in range(3):
                v[k, 0], v[k, 2] = c * v[k, 0] - s * v[k, 2], s * v[k, 0] + c * v[k, 2]
        if not _is_negligible(yz, yy, zz):
            done = False
            t, c, s = _rotation(yy, zz, yz)
            yy, zz, yz = yy - t * yz, zz + t * yz, 0.0
            xy, xz = c * xy - s * xz, s * xy + c * xz
            for k in range(3):
                v[k, 1], v[k, 2] = c * v[k, 1] - s * v[k, 2], s * v[k, 1] + c * v[k, 2]
        if done:
            break
    _store_sorted(xx, yy, zz, v, values, vectors)


@inlined
def _store_sorted(a: float, b: float, c: float, v, values, vectors) -> None:
    """Write eigenpairs in ascending order of eigenvalue."""
    i, j, k = 0, 1, 2
    values[0], values[1], values[2] = a, b, c
    if values[i] > values[j]:
        i, j = j, i
    if values[j] > values[k]:
        j, k = k, j
    if values[i] > values[j]:
        i, j = j, i
    low, mid, high = values[i], values[j], values[k]
    values[0], values[1], values[2] = low, mid, high
    for r in range(3):
        vectors[r, 0], vectors[r, 1], vectors[r, 2] = v[r, i], v[r, j], v[r, k]


@inner(cache=True)
def solve3(matrix, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Solution of a positive definite 3x3 system by the factors L D L^T; of `matrix` the upper triangle, six entries.

    NaN or infinity where the matrix is singular to the last digit.
    """
    xx, xy, xz, yy, yz, zz = matrix
    a, b = xy / xx, xz / xx
    d = yy - a * xy
    c = (yz - a * xz) / d
    y -= a * x
    z -= b * x + c * y
    z /= zz - b * xz - c * c * d
    y = y / d - c * z
    return x / xx - a * y - b * z, y, z
