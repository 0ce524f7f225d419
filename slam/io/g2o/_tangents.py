"""What g2o calls error, in terms of GTSAM's tangents: pose errors and plane errors, to first order at zero."""

from __future__ import annotations

import gtsam
import numpy as np

from spplanes._check import FloatArray

#: Rotations (3, 3) of the sensor frames that planes are measured in: the body's own, and one whose x axis is its z.
#: g2o writes the error of a plane in azimuth and elevation of its normal, which know no direction at the poles: a
#: floor is measured in the second frame, where it is a wall.
SENSORS = np.eye(3), np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
#: Derivative (6, 6) of g2o's pose error (x, y, z, qx, qy, qz) by GTSAM's tangent (rx, ry, rz, x, y, z), at zero error:
#: the imaginary part of the quaternion is half the rotation vector.
POSE_JACOBIAN = np.kron([[0.0, 1.0], [0.5, 0.0]], np.eye(3))


def sensor_for(normal: FloatArray) -> int:
    """Which of `SENSORS` has a normal (3,) of the body frame far from its poles."""
    return int(abs(normal[2]) > np.sqrt(0.5))


def plane_jacobian(measured: gtsam.OrientedPlane3, body_R_sensor: FloatArray) -> FloatArray:
    """Derivative (3, 3) of g2o's plane error by that of GTSAM's `LocalOrientedPlane3Factor`; it is orthogonal.

    g2o's error of a predicted plane against the measured one is (azimuth, elevation) of the *measured* normal in axes
    turned so that the predicted one is x, and d_predicted - d_measured, with n.x = d. GTSAM's is B^T n_predicted, with
    B the basis of the measured normal, and the same difference. What moves the predicted normal one way moves the
    measured one, seen from it, the other way.
    """
    normal = measured.normal().point3()
    axes = body_R_sensor @ _azimuth_elevation_axes(body_R_sensor.T @ normal)
    jacobian = np.eye(3)
    jacobian[:2, :2] = -axes.T @ measured.normal().basis()
    return jacobian


def measured_plane(seen: gtsam.OrientedPlane3, step: FloatArray) -> tuple[gtsam.OrientedPlane3, FloatArray]:
    """The plane whose `LocalOrientedPlane3Factor` has at `seen` the error and the slope that a given factor has there.

    Of `seen`, the plane in the frame of the pose, and the tangent `step` (3,) from it against which the given factor's
    error grows: with its whitened error w and Jacobian A at `seen`, A step = w. Returns the plane m with e(m) = D(m)
    step, and D, the derivative (3, 3) of the error e by the tangent of `seen`.
    """
    measured = seen.retract(-step)
    for _ in range(30):
        missing = plane_error(measured, seen) - _slope(measured, seen) @ step
        if np.abs(missing).max() < 1e-14 * (1.0 + abs(seen.distance())):
            break
        measured = measured.retract(missing * np.array([1.0, 1.0, -1.0]))
    return measured, _slope(measured, seen)


def plane_error(measured: gtsam.OrientedPlane3, seen: gtsam.OrientedPlane3) -> FloatArray:
    """Error (3,) of `LocalOrientedPlane3Factor`: B^T n_seen with B the basis of the measured normal, d_seen - d."""
    tilt = measured.normal().basis().T @ seen.normal().point3()
    return np.array([tilt[0], tilt[1], measured.planeCoefficients()[3] - seen.planeCoefficients()[3]])


def _slope(measured: gtsam.OrientedPlane3, seen: gtsam.OrientedPlane3) -> FloatArray:
    """Derivative (3, 3) of that error by the tangent of `seen`."""
    slope = -np.eye(3)
    slope[:2, :2] = measured.normal().basis().T @ seen.normal().basis()
    return slope


def root_information(upper: FloatArray, size: int) -> FloatArray:
    """Upper triangular R, shape (n, n), with R^T R the information matrix whose upper half is given, row by row.

    A ValueError refuses one that is not positive semidefinite. Rank may be missing: a line leaves a direction of its
    plane open, a prior may hold some coordinates only.
    """
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = upper
    values, vectors = np.linalg.eigh(matrix + np.triu(matrix, 1).T)
    if values[0] < -1e-9 * max(values[-1], 0.0):
        raise ValueError("expected a positive semidefinite information matrix, got one with a negative eigenvalue")
    scaled = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return np.asarray(np.linalg.qr(scaled, mode="r"))


def _azimuth_elevation_axes(normal: FloatArray) -> FloatArray:
    """Unit vectors (3, 2) along which a unit normal (3,) moves when its azimuth and its elevation grow."""
    level = float(np.hypot(normal[0], normal[1]))
    c, s = (normal[0] / level, normal[1] / level) if level > 0.0 else (1.0, 0.0)
    return np.array([[-s, -c * normal[2]], [c, -s * normal[2]], [0.0, level]])
