"""Kernels of rigid motions: exponential and logarithm of SE(3), tangent order (rotation, translation) as in GTSAM.

References:
    Barfoot, "State Estimation for Robotics", 2017, eqs. 7.85 and 7.95 for the two Jacobians.
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, njit

#: Angles below this, rad, take the series of what else would be nought by nought.
_SMALL = 1e-5


@njit(cache=True)
def expmap(tangent):
    """The rigid motion (4, 4) of a tangent vector (6,), rad and m."""
    x, y, z = tangent[0], tangent[1], tangent[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < _SMALL:
        a, b, c = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        a, b, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square, (angle - np.sin(angle)) / (square * angle)
    motion, across = np.zeros((4, 4)), ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    motion[3, 3] = 1.0
    for i in range(3):
        row = across[i]
        for j in range(3):
            twice, one = tangent[i] * tangent[j] - (square if i == j else 0.0), 1.0 if i == j else 0.0
            motion[i, j] = one + (a * row[j] + b * twice)
            motion[i, 3] += (one + (b * row[j] + c * twice)) * tangent[3 + j]
    return motion


@njit(cache=True)
def logmap(motion):
    """The tangent vector (6,) of a rigid motion (4, 4), turns of up to pi."""
    tangent = np.empty(6)
    _log_of_rotation(motion, tangent)
    x, y, z = tangent[0], tangent[1], tangent[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    c = 1.0 / 12.0
    if angle >= _SMALL:
        c = (1.0 - 0.5 * angle * np.sin(angle) / (1.0 - np.cos(angle))) / square
    across = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))
    for i in range(3):
        row = across[i]
        tangent[3 + i] = motion[i, 3]
        for j in range(3):
            twice = tangent[i] * tangent[j] - (square if i == j else 0.0)
            tangent[3 + i] += (c * twice - 0.5 * row[j]) * motion[j, 3]
    return tangent


@inlined
def _log_of_rotation(R, tangent):
    """Write the rotation vector of R, the first three rows and columns, by the quaternion's largest entry."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    if trace > 0.0:
        w, x, y, z = 1.0 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        w, x = R[2, 1] - R[1, 2], 1.0 + R[0, 0] - R[1, 1] - R[2, 2]
        y, z = R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]
    elif R[1, 1] >= R[2, 2]:
        w, y = R[0, 2] - R[2, 0], 1.0 + R[1, 1] - R[0, 0] - R[2, 2]
        x, z = R[0, 1] + R[1, 0], R[1, 2] + R[2, 1]
    else:
        w, z = R[1, 0] - R[0, 1], 1.0 + R[2, 2] - R[0, 0] - R[1, 1]
        x, y = R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = np.sqrt(x * x + y * y + z * z)
    scale = 2.0 / w if sine < _SMALL * w else 2.0 * np.arctan2(sine, w) / sine
    tangent[0], tangent[1], tangent[2] = scale * x, scale * y, scale * z


@inlined
def product(one, other):
    """The rigid motion (4, 4) of two, one after the other."""
    result = np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            result[i, j] = 0.0
            for k in range(4):
                result[i, j] += one[i, k] * other[k, j]
    return result


@inlined
def solve_positive(matrix, right, lower):
    """Solution of a positive definite system, in place of its right side, by Cholesky's factor, written to `lower`."""
    n = right.size
    for i in range(n):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = np.sqrt(total) if i == j else total / lower[j, j]
    for i in range(n):
        for k in range(i):
            right[i] -= lower[i, k] * right[k]
        right[i] /= lower[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            right[i] -= lower[k, i] * right[k]
        right[i] /= lower[i, i]
