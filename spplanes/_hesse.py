"""Between a plane's frame with (z, theta, psi) and its Hesse form (n, d)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_shape


def frame_from_hesse(normal: FloatArray, d: float, centre: ArrayLike | None) -> FloatArray:
    """A (4, 4) frame of the plane n.x = d: origin at the foot of ``centre``, x axis away from n's largest component."""
    length = float(np.linalg.norm(normal))
    if abs(length - 1.0) > 1e-6:
        raise ValueError(f"normal: expected a unit vector, got one of length {length:.6g}")
    if not np.isfinite(d):
        raise ValueError(f"d: expected a finite number, got {d}")
    n = normal / length
    origin = np.zeros(3) if centre is None else as_shape("centre", centre, (3,))
    frame = np.eye(4)
    axis = np.eye(3)[np.argmin(np.abs(n))]
    x = axis - (axis @ n) * n
    frame[:3, 0] = x / np.linalg.norm(x)
    frame[:3, 1] = np.cross(n, frame[:3, 0])
    frame[:3, 2] = n
    frame[:3, 3] = origin + (d / length - n @ origin) * n
    return frame


def hesse_jacobian(frame: FloatArray) -> FloatArray:
    """(4, 3) derivative of (n, d) by (z, theta, psi): dn = theta x - psi y, dd = z + dn.c."""
    jacobian = np.zeros((4, 3))
    jacobian[:3, 1] = frame[:3, 0]
    jacobian[:3, 2] = -frame[:3, 1]
    jacobian[3] = frame[:3, 3] @ jacobian[:3]
    jacobian[3, 0] = 1.0
    return jacobian


def covariance_from_hesse(frame: FloatArray, covariance: FloatArray) -> FloatArray:
    """(3, 3) covariance of (z, theta, psi) from the (4, 4) one of (n, d): theta = x.dn, psi = -y.dn, z = dd - c.dn. In
    z, dn is taken without its part along n, which a unit vector does not have."""
    x, y, c = frame[:3, 0], frame[:3, 1], frame[:3, 3]
    inverse = np.zeros((3, 4))
    inverse[1, :3], inverse[2, :3] = x, -y
    inverse[0, :3] = -(x @ c) * x - (y @ c) * y
    inverse[0, 3] = 1.0
    result = inverse @ covariance @ inverse.T
    return 0.5 * (result + result.T)


def slopes_in(frame: FloatArray, plane_frame: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A plane as z(x, y) = p_z - theta x + psi y in another ``frame``: (p_z, theta, psi) and its (3, 3) covariance. The
    plane must not be seen edge-on from the frame's z axis."""
    rotation = frame[:3, :3].T @ plane_frame[:3, :3]
    centre = frame[:3, :3].T @ (plane_frame[:3, 3] - frame[:3, 3])
    a, b, c = rotation[:, 2]
    d = rotation[:, 2] @ centre
    local = np.eye(4)
    local[:3, :3], local[:3, 3] = rotation, centre
    by_hesse = np.array(
        [[0.0, 0.0, -d / c**2, 1.0 / c], [1.0 / c, 0.0, -a / c**2, 0.0], [0.0, -1.0 / c, b / c**2, 0.0]]
    )
    jacobian = by_hesse @ hesse_jacobian(local)
    return np.array([d / c, a / c, -b / c]), jacobian @ covariance @ jacobian.T
