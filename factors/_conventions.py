"""Where SP planes become GTSAM planes: signs, tangent order, bases. Nowhere else.

Measured on the gtsam 4.3.0 wheel and pinned in ``tests/factors/test_conventions.py``:

* ``OrientedPlane3(n, D)`` holds n.x + D = 0, so D = -d of the Hesse form n.x = d used everywhere in this project.
* ``p.retract([a, b, c])`` moves the normal along ``p.normal().basis()`` by (a, b) and sets D + c, hence d - c.
* The error of ``LocalOrientedPlane3Factor`` is e = [B^T n_pred, D_meas - D_pred] = [B^T n_pred, d_pred - d_meas],
  with B the basis of the *measured* normal: its third component has the sign opposite to that of ``retract``.
* The tangent of ``Pose3`` is (rx, ry, rz, x, y, z), on the right; the SPmodel differential is
  (x, y, z, phi, theta, psi) with rotations about z, y, x: the permutation `SP_TO_POSE3`.
"""

from __future__ import annotations

import gtsam
import numpy as np

from factors._custom import OF_POSE2
from factors._kernels import unit_basis
from spplanes._check import FloatArray, check_instance

#: ``tangent_pose3 = differential_sp[SP_TO_POSE3]``.
SP_TO_POSE3 = np.array([5, 4, 3, 0, 1, 2])
#: The way back: ``differential_sp = tangent_pose3[POSE3_TO_SP]``.
POSE3_TO_SP = np.array([3, 4, 5, 2, 1, 0])


def planar_motion(
    delta: FloatArray, covariance: FloatArray, out_of_plane_sigmas: tuple[float, float, float]
) -> tuple[gtsam.Pose3, FloatArray]:
    """A motion on a floor as a Pose3 with the covariance (6, 6) of its tangent.

    Args:
        delta: (x, y, theta), m and rad, shape (3,).
        covariance: of these, x and y along the axes of the start, shape (3, 3), symmetric to rounding.
        out_of_plane_sigmas: of (z m, roll rad, pitch rad), along the axes of the end.
    """
    x, y, theta = delta.tolist()
    z, roll, pitch = out_of_plane_sigmas
    full = np.zeros((6, 6))
    full[np.ix_(OF_POSE2, OF_POSE2)] = in_frame_of_end(theta, 0.5 * (covariance + covariance.T))
    full[5, 5], full[0, 0], full[1, 1] = z**2, roll**2, pitch**2
    return gtsam.Pose3(gtsam.Rot3.Yaw(theta), np.array([x, y, 0.0])), full


def in_frame_of_end(theta: float, covariance: FloatArray) -> FloatArray:
    """Covariance of (x, y, theta) additive in the axes of a motion's start, turned to those of its end, (3, 3)."""
    c, s = np.cos(theta), np.sin(theta)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return turn @ covariance @ turn.T


def oriented_plane(normal: FloatArray, d: float) -> gtsam.OrientedPlane3:
    """GTSAM plane of the Hesse plane n.x = d; ``normal`` has shape (3,)."""
    return gtsam.OrientedPlane3(np.array([normal[0], normal[1], normal[2], -d]))


def landmark_hesse(landmark: gtsam.OrientedPlane3) -> tuple[FloatArray, float]:
    """Normal, shape (3,), and distance d in n.x = d of a GTSAM plane."""
    check_instance("landmark", landmark, gtsam.OrientedPlane3)
    coefficients = landmark.planeCoefficients()
    return coefficients[:3], -float(coefficients[3])


def error_to_sp(frames: FloatArray) -> FloatArray:
    """Matrices M with p = M e, shape (N, 3, 3), for frames (N, 4, 4).

    e = [B^T n_true, d_true - d_measured] is what the plane factors call error, p = (z, theta, psi) the SP perturbation
    that takes the measured plane to the true one. From dn = theta x - psi y and d = n.o + z:
    theta = x.B e_12, psi = -y.B e_12, z = e_3 - o.B e_12.
    """
    normals = np.ascontiguousarray(frames[:, :3, 2])
    basis = np.reshape([unit_basis(normal) for normal in normals], (-1, 3, 2))
    matrices = np.zeros((len(frames), 3, 3))
    matrices[:, 0, :2] = -np.einsum("ni,nij->nj", frames[:, :3, 3], basis)
    matrices[:, 0, 2] = 1.0
    matrices[:, 1, :2] = np.einsum("ni,nij->nj", frames[:, :3, 0], basis)
    matrices[:, 2, :2] = -np.einsum("ni,nij->nj", frames[:, :3, 1], basis)
    return matrices


def square_root_informations(frames: FloatArray, covariances: FloatArray) -> FloatArray:
    """Upper triangular R with |R e|^2 = p^T C^-1 p, shape (N, 3, 3); `numpy.linalg.LinAlgError` when a C is singular.

    It never forms the covariance of e: the lever arm of a plane far from the sensor makes that one badly conditioned.
    """
    whitener = np.linalg.solve(np.linalg.cholesky(covariances), error_to_sp(frames))
    return np.asarray(np.linalg.qr(whitener, mode="r"))


def centre_root_informations(covariances: FloatArray) -> FloatArray:
    """Upper triangular R with |R e|^2 = p^T C^-1 p, shape (N, 3, 3), for e = (theta, -psi, z) of `plane_error`."""
    order = np.array([1, 2, 0])
    signs = np.array([1.0, -1.0, 1.0])
    turned = covariances[:, order[:, None], order] * np.outer(signs, signs)
    identities = np.broadcast_to(np.eye(3), covariances.shape)
    return np.asarray(np.linalg.qr(np.linalg.solve(np.linalg.cholesky(turned), identities), mode="r"))


def second_order(frames: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What a tilt e of the measured plane does to its distance beyond the first order: -d |e|^2 / 2.

    The native factor's distance is that of the foot of the perpendicular from the pose, not of the patch, and this is
    what it neglects. Mean (N,) and variance (N,) of it under the planes' own tilt covariance.
    """
    tilts = covariances[:, 1:, 1:]
    distances = np.einsum("ni,ni->n", frames[:, :3, 2], frames[:, :3, 3])
    mean = -0.5 * distances * np.trace(tilts, axis1=1, axis2=2)
    return mean, 0.5 * distances**2 * np.einsum("nij,nji->n", tilts, tilts)


def tangent_to_sp(frame: FloatArray) -> FloatArray:
    """Matrix M with p = M v, shape (3, 3), v being the tangent of ``OrientedPlane3.retract``."""
    matrix = error_to_sp(frame[None])[0].copy()
    matrix[:, 2] *= -1.0
    return matrix


def plane_frame(normal: FloatArray, d: float, centre: FloatArray) -> FloatArray:
    """Plane frame, shape (4, 4), with its origin at ``centre`` (3,) dropped onto n.x = d, and an arbitrary x axis."""
    axis = np.zeros(3)
    axis[np.argmin(np.abs(normal))] = 1.0
    x = np.cross(axis, normal)
    x /= np.linalg.norm(x)
    frame = np.eye(4)
    frame[:3, 0], frame[:3, 1], frame[:3, 2] = x, np.cross(normal, x), normal
    frame[:3, 3] = centre + (d - normal @ centre) * normal
    return frame


def hesse_to_sp(frame: FloatArray) -> FloatArray:
    """Matrix M, shape (3, 4), with p = M (dn, dd) for a small change of (n, d) of the plane of ``frame`` (4, 4)."""
    x, y, origin = frame[:3, 0], frame[:3, 1], frame[:3, 3]
    return np.array([[*-origin, 1.0], [*x, 0.0], [*-y, 0.0]])
