"""Numba kernels on moment rows, the weighted moments of a point set in eleven numbers, and on 3x3 symmetric matrices.

For the rows see ``spplanes.moments``. Eigenvalues are found by Jacobi rotations, accurate when near-degenerate.
"""

from __future__ import annotations

import math

import numpy as np

from spplanes._jit import inlined, inner, njit

#: Length of a moment row: n, W, cx, cy, cz, Sxx, Sxy, Sxz, Syy, Syz, Szz.
ROW_SIZE = 11

#: No viewpoint, as the kernels take it.
NO_VIEWPOINT = np.full(3, np.nan)
#: Outcome of a fit, as the kernels report it.
OK, TOO_FEW, COINCIDENT, COLLINEAR, OPEN_POSES = 0, 1, 2, 3, 4
#: Points are collinear when their width is below this share of their length.
COLLINEAR_RATIO = 1e-6


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


@inlined
def copy_into(target, source) -> None:
    """`target[:n] = source` of n rows: for the message of its error numba compiles seconds of the handling of text."""
    for i in range(source.shape[0]):
        for j in range(source.shape[1]):
            target[i, j] = source[i, j]


@njit(cache=True)
def symmetric3(upper):
    """The symmetric 3x3 matrix with this upper triangle, shape (6,)."""
    matrix, at = np.empty((3, 3)), 0
    for j in range(3):
        for k in range(j, 3):
            matrix[j, k] = matrix[k, j] = upper[at]
            at += 1
    return matrix


@njit(cache=True)
def jacobi3(upper, values, vectors) -> None:
    """Eigenvalues, ascending, and eigenvectors of `symmetric3`, into (3,) and the columns of (3, 3), by cyclic Jacobi
    rotations. A small eigenvalue of a positive semidefinite matrix is found to rounding of the matrix' entries, and
    eigenvectors stay orthogonal to rounding, also when eigenvalues tie."""
    m = symmetric3(upper)
    for j in range(3):
        for k in range(3):
            vectors[j, k] = 1.0 if j == k else 0.0
    for _ in range(30):  # a few do as a rule
        done = True
        for p, q, other in ((0, 1, 2), (0, 2, 1), (1, 2, 0)):
            if _is_negligible(m[p, q], m[p, p], m[q, q]):
                continue
            done = False
            t, c, s = _rotation(m[p, p], m[q, q], m[p, q])
            m[p, p], m[q, q] = m[p, p] - t * m[p, q], m[q, q] + t * m[p, q]
            m[p, q] = m[q, p] = 0.0
            m[p, other], m[q, other] = c * m[p, other] - s * m[q, other], s * m[p, other] + c * m[q, other]
            m[other, p], m[other, q] = m[p, other], m[q, other]
            for k in range(3):
                vectors[k, p], vectors[k, q] = (
                    c * vectors[k, p] - s * vectors[k, q],
                    s * vectors[k, p] + c * vectors[k, q],
                )
        if done:
            break
    for k in range(3):
        values[k] = m[k, k]
    for j, k in ((0, 1), (1, 2), (0, 1)):
        if values[j] > values[k]:
            values[j], values[k] = values[k], values[j]
            for r in range(3):
                vectors[r, j], vectors[r, k] = vectors[r, k], vectors[r, j]


@inner(cache=True)
def column(frame, k: int) -> tuple[float, float, float]:
    """An axis of a frame, or its origin, k = 3."""
    return frame[0, k], frame[1, k], frame[2, k]


@inner(cache=True)
def dot(a, b) -> float:
    """Scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner(cache=True)
def times(matrix, v) -> tuple[float, float, float]:
    """Product of a symmetric matrix, whose upper triangle is read, and a vector."""
    return (
        matrix[0, 0] * v[0] + matrix[0, 1] * v[1] + matrix[0, 2] * v[2],
        matrix[0, 1] * v[0] + matrix[1, 1] * v[1] + matrix[1, 2] * v[2],
        matrix[0, 2] * v[0] + matrix[1, 2] * v[1] + matrix[2, 2] * v[2],
    )


@inner(cache=True)
def cross(a, b) -> tuple[float, float, float]:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner(cache=True)
def minus(a, b) -> tuple[float, float, float]:
    """Difference of two vectors."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inner(cache=True)
def over(v, size: float) -> tuple[float, float, float]:
    """A vector divided by a number."""
    return v[0] / size, v[1] / size, v[2] / size


@inner(cache=True)
def in_frame(points, i: int, frame) -> tuple[float, float, float]:
    """Coordinates of a point in a frame."""
    off = minus(points[i], column(frame, 3))
    return dot(column(frame, 0), off), dot(column(frame, 1), off), dot(column(frame, 2), off)


@inner(cache=True)
def solve3(matrix, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Solution of a positive definite 3x3 system, `matrix` its upper triangle, by L D L^T; NaN or infinity if
    singular."""
    xx, xy, xz, yy, yz, zz = matrix
    a, b = xy / xx, xz / xx
    d = yy - a * xy
    c = (yz - a * xz) / d
    y -= a * x
    z -= b * x + c * y
    z /= zz - b * xz - c * c * d
    y = y / d - c * z
    return x / xx - a * y - b * z, y, z


@inner(cache=True)
def add_square(upper, w: float, v) -> None:
    """Add w v v^T to a matrix by its upper triangle, (6,)."""
    upper[0] += w * v[0] * v[0]
    upper[1] += w * v[0] * v[1]
    upper[2] += w * v[0] * v[2]
    upper[3] += w * v[1] * v[1]
    upper[4] += w * v[1] * v[2]
    upper[5] += w * v[2] * v[2]


@inner(cache=True)
def add_point(row, p, w: float) -> None:
    """Add point ``p``, shape (3,), with weight ``w`` to a moment row in place."""
    row[0] += 1.0
    if w <= 0.0:
        return
    total, off = row[1] + w, minus(p, row[2:5])
    add_square(row[5:], w * (row[1] / total), off)
    row[1] = total
    for k in range(3):
        row[2 + k] += w / total * off[k]


@njit(cache=True)
def merge_rows(a, b, out) -> None:
    """Write the moments of the union of two disjoint point sets to ``out``, which may be ``a`` or ``b``."""
    merge_scaled(out, a, 1.0, b, 1.0)


@njit(cache=True)
def merge_scaled(out, a, scale_a: float, b, scale_b: float) -> None:
    """`merge_rows` of two rows the weights of which are multiplied by a scale each."""
    wa, wb = a[1] * scale_a, b[1] * scale_b
    total = wa + wb
    share, off = wb / total if total > 0.0 else 0.0, minus(b[2:5], a[2:5])
    out[0], out[1] = a[0] + b[0], total
    out[2], out[3], out[4] = a[2] + share * off[0], a[3] + share * off[1], a[4] + share * off[2]
    for k in range(5, 11):
        out[k] = a[k] * scale_a + b[k] * scale_b
    add_square(out[5:], wa * share, off)


@njit(cache=True)
def smallest_eigen(row) -> tuple[float, float, float, float]:
    """Smallest eigenvalue of the scatter and its unit eigenvector: (value, nx, ny, nz), the sign of n left open. With
    inverse-variance weights the value is the chi2 of the plane through the centre with that normal."""
    values = np.empty(3)
    vectors = np.empty((3, 3))
    jacobi3(row[5:], values, vectors)
    return max(values[0], 0.0), vectors[0, 0], vectors[1, 0], vectors[2, 0]


@njit(cache=True)
def points_row(points, weights, row) -> None:
    """Write the moments of ``points`` (N, 3) with ``weights`` (N,) to ``row``: two passes, so nothing cancels."""
    n = points.shape[0]
    total = 0.0
    sx = sy = sz = 0.0
    ox, oy, oz = points[0, 0], points[0, 1], points[0, 2]
    for i in range(n):
        w = weights[i]
        total += w
        sx += w * (points[i, 0] - ox)
        sy += w * (points[i, 1] - oy)
        sz += w * (points[i, 2] - oz)
    row[0], row[1] = n, total
    row[2], row[3], row[4] = ox + sx / total, oy + sy / total, oz + sz / total
    row[5:11] = 0.0
    for i in range(n):
        add_square(row[5:], weights[i], minus(points[i], row[2:5]))


@inner(cache=True)
def _largest(v) -> float:
    """The component of a vector that is farthest from 0."""
    largest = v[0]
    for k in range(1, 3):
        if abs(v[k]) > abs(largest):
            largest = v[k]
    return largest


@inner(cache=True)
def faces_viewpoint(n, c, viewpoint) -> bool:
    """Whether normal ``n`` at centre ``c`` has the agreed sign: to the viewpoint or, where that is NaN, d >= 0."""
    side, d = dot(n, minus(viewpoint, c)), dot(n, c)
    if side > 0.0 or side < 0.0:
        return side > 0.0
    return d > 0.0 if d != 0.0 else _largest(n) > 0.0


@inner(cache=True)
def write_frame(n, x, c, frame) -> None:
    """Write the (4, 4) frame with z axis ``n``, x axis along ``x`` (largest component positive), origin ``c``."""
    sign = 1.0 if _largest(x) >= 0.0 else -1.0
    x = sign * x[0], sign * x[1], sign * x[2]
    y = cross(n, x)
    for k in range(3):
        frame[k, 0], frame[k, 1], frame[k, 2], frame[k, 3], frame[3, k] = x[k], y[k], n[k], c[k], 0.0
    frame[3, 3] = 1.0


@njit(cache=True)
def row_frame(row, viewpoint, frame, values) -> int:
    """Plane frame (4, 4) of a moment row, normal as of `faces_viewpoint`, and its eigenvalues, ascending; the
    outcome."""
    vectors = np.empty((3, 3))
    jacobi3(row[5:], values, vectors)
    values[0] = max(values[0], 0.0)
    if row[0] < 3.0:
        return TOO_FEW
    size = 1e-15 * max(abs(row[2]), abs(row[3]), abs(row[4]))  # by which coordinates are rounded
    nothing = row[1] * size * size
    if not values[2] > nothing or values[2] < 1e-300:
        return COINCIDENT
    if values[1] <= nothing or values[1] <= COLLINEAR_RATIO * COLLINEAR_RATIO * values[2]:
        return COLLINEAR
    normal, centre = vectors[:, 0].copy(), row[2:5]
    if not faces_viewpoint(normal, centre, viewpoint):
        normal = -normal
    write_frame(normal, vectors[:, 2].copy(), centre, frame)
    return OK
