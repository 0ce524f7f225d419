"""Kernels of rigid motions: exponential and logarithm of SE(3), tangent order (rotation, translation) as in GTSAM.

References:
    Barfoot, "State Estimation for Robotics", 2017, eqs. 7.85 and 7.95 for the two Jacobians.
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined

#: Angles below this, rad, take the series of what else would be nought by nought.
_SMALL = 1e-5


@inlined
def expmap(tangent):
    """The rigid motion (4, 4) of a tangent vector (6,), rad and m."""
    x, y, z = tangent[0], tangent[1], tangent[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if angle < _SMALL:
        a, b, c = 1.0 - square / 6.0, 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        a, b, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square, (angle - np.sin(angle)) / (square * angle)
    motion, left = np.eye(4), np.eye(3)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    for i in range(3):
        for j in range(3):
            twice = tangent[i] * tangent[j] - (square if i == j else 0.0)
            motion[i, j] += a * across[i, j] + b * twice
            left[i, j] += b * across[i, j] + c * twice
    for i in range(3):
        motion[i, 3] = left[i, 0] * tangent[3] + left[i, 1] * tangent[4] + left[i, 2] * tangent[5]
    return motion


@inlined
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
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    for i in range(3):
        tangent[3 + i] = motion[i, 3]
        for j in range(3):
            twice = tangent[i] * tangent[j] - (square if i == j else 0.0)
            tangent[3 + i] += (c * twice - 0.5 * across[i, j]) * motion[j, 3]
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
