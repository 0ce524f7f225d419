"""The arithmetic of the custom factors: errors with their analytic derivatives, those of single planes compiled.

Columns of every derivative: 0-5 the observing pose (rx, ry, rz, x, y, z; on the right), 6-11 the anchor pose, 12-14 the
landmark in the tangent of ``OrientedPlane3.retract``, 15-17 a second landmark that lives in the observing pose's frame;
of a map 15-17, 18-20, ... its other landmarks.
Planes are rows (nx, ny, nz, d) in Hesse form, n.x = d; landmarks come as GTSAM's coefficients (nx, ny, nz, -d).
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inner, njit
from spplanes._rows import cross, dot, over
from spplanes.spmodel import skew

_Error = tuple[np.ndarray, np.ndarray]


@njit(cache=True)
def unit_basis(n):
    """Tangent basis of a unit vector, shape (3, 2), the very one of ``gtsam.Unit3.basis()``, ties included."""
    mx, my, mz = abs(n[0]), abs(n[1]), abs(n[2])
    axis, basis = np.zeros(3), np.empty((3, 2))
    if mx <= my and mx <= mz:
        axis[0] = 1.0
    elif my <= mx and my <= mz:
        axis[1] = 1.0
    else:
        axis[2] = 1.0
    first = scaled_to_one(cross(n, axis))
    second = scaled_to_one(cross(n, first))
    for k in range(3):
        basis[k, 0], basis[k, 1] = first[k], second[k]
    return basis


@inner(cache=True)
def scaled_to_one(v):
    """A vector, scaled to the length one."""
    return over(v, np.sqrt(dot(v, v)))


@njit(cache=True)
def plane_seen_from(world_T_anchor, world_T_body, coefficients):
    """Landmark (GTSAM coefficients (4,)) of an anchor's frame seen from a body: Hesse row (4,), derivative (4, 15)."""
    normal = coefficients[:3].copy()
    rotation = np.empty((3, 3))
    shift = np.empty(3)
    for i in range(3):
        shift[i] = 0.0
        for k in range(3):
            shift[i] += world_T_anchor[k, i] * (world_T_body[k, 3] - world_T_anchor[k, 3])
        for j in range(3):
            rotation[i, j] = (
                world_T_anchor[0, i] * world_T_body[0, j]
                + world_T_anchor[1, i] * world_T_body[1, j]
                + world_T_anchor[2, i] * world_T_body[2, j]
            )
    basis = unit_basis(normal)
    swing = cross(shift, normal)
    seen = np.empty(4)
    jacobian = np.zeros((4, 15))
    for i in range(3):
        seen[i] = rotation[0, i] * normal[0] + rotation[1, i] * normal[1] + rotation[2, i] * normal[2]
        across = cross(normal, rotation[:, i])
        for j in range(3):
            jacobian[i, 6 + j] = across[j]
        for j in range(2):
            jacobian[i, 12 + j] = (
                rotation[0, i] * basis[0, j] + rotation[1, i] * basis[1, j] + rotation[2, i] * basis[2, j]
            )
    seen[3] = -coefficients[3] - (normal[0] * shift[0] + normal[1] * shift[1] + normal[2] * shift[2])
    jacobian[0, 1], jacobian[0, 2] = -seen[2], seen[1]
    jacobian[1, 0], jacobian[1, 2] = seen[2], -seen[0]
    jacobian[2, 0], jacobian[2, 1] = -seen[1], seen[0]
    for j in range(3):
        jacobian[3, 3 + j] = -seen[j]
        jacobian[3, 6 + j] = swing[j]
        jacobian[3, 9 + j] = normal[j]
    for j in range(2):
        jacobian[3, 12 + j] = -(basis[0, j] * shift[0] + basis[1, j] * shift[1] + basis[2, j] * shift[2])
    jacobian[3, 14] = -1.0
    return seen, jacobian


@njit(cache=True)
def plane_error(world_T_anchor, world_T_body, coefficients, frame):
    """Error of a landmark against a measured plane frame (4, 4), shape (3,), and its derivative (3, 15).

    (x.n, y.n, d - n.o) with x, y, o the axes and the origin of the measured frame: (theta, -psi, z) of the SP
    perturbation that takes the measurement to the landmark, without a first-order step over the lever arm |o|.
    """
    seen, jacobian = plane_seen_from(world_T_anchor, world_T_body, coefficients)
    error = np.empty(3)
    derivative = np.empty((3, 15))
    for i in range(2):
        error[i] = frame[0, i] * seen[0] + frame[1, i] * seen[1] + frame[2, i] * seen[2]
        for j in range(15):
            derivative[i, j] = (
                frame[0, i] * jacobian[0, j] + frame[1, i] * jacobian[1, j] + frame[2, i] * jacobian[2, j]
            )
    error[2] = seen[3] - (frame[0, 3] * seen[0] + frame[1, 3] * seen[1] + frame[2, 3] * seen[2])
    for j in range(15):
        derivative[2, j] = jacobian[3, j] - (
            frame[0, 3] * jacobian[0, j] + frame[1, 3] * jacobian[1, j] + frame[2, 3] * jacobian[2, j]
        )
    return error, derivative


@njit(cache=True)
def two_point_information(points, sigma):
    """Distances of two body-frame points (2, 3) from a landmark as a native factor: "measured" normal, and R (3, 3).

    n.q - d is a linear function of the factor's error [B^T n, d - d_measured] if q lies in the span of B: so the
    measured plane is made the one through both points and the body's origin. Then n.q = (B^T q).(B^T n), exactly,
    whatever the landmark; its own normal plays no part. R is upper triangular with an empty last row.
    """
    normal = cross(points[0], points[1])
    first, second = np.abs(points[0]).max(), np.abs(points[1]).max()
    if np.sqrt(dot(normal, normal)) < 1e-9 * max(first, second) ** 2:
        along = points[0] if first >= second else points[1]  # in line with the origin: any plane through that line
        axis = np.zeros(3)
        least = 0
        for k in range(1, 3):
            least = k if abs(along[k]) < abs(along[least]) else least
        axis[least] = 1.0
        normal = cross(along, axis)
    normal = scaled_to_one(normal)
    basis = unit_basis(normal)
    root = np.zeros((3, 3))
    for i in range(2):
        for j in range(2):
            root[i, j] = (points[i, 0] * basis[0, j] + points[i, 1] * basis[1, j] + points[i, 2] * basis[2, j]) / sigma
        root[i, 2] = -1.0 / sigma
    if root[1, 0] != 0.0:  # the Householder reflection that empties it
        beta = -np.copysign(np.sqrt(root[0, 0] ** 2 + root[1, 0] ** 2), root[0, 0])
        tau, v = (beta - root[0, 0]) / beta, root[1, 0] / (root[0, 0] - beta)
        for j in range(1, 3):
            share = tau * (root[0, j] + v * root[1, j])
            root[0, j] -= share
            root[1, j] -= v * share
        root[0, 0], root[1, 0] = beta, 0.0
    return normal, root


#: Sine of the angle between a plane and the scan plane below which `line_error` stops dividing by it.
GRAZING = 0.02


@njit(cache=True)
def line_error(world_T_anchor, world_T_body, coefficients, body_T_sensor, points):
    """Distances in the scan plane from two measured points (2, 2) to where a landmark cuts it; derivative (2, 15).

    With (n, d) the landmark in the sensor frame, which is its error there as of a plane, and m = (n_x, n_y), it cuts
    the scan plane in m.q = d; the distance of a point q to that line is (d - m.q) / |m|.
    """
    in_sensor, by_tangents = plane_error(world_T_anchor, world_T_body, coefficients, body_T_sensor)
    length = np.sqrt(in_sensor[0] ** 2 + in_sensor[1] ** 2)
    error = np.empty(2)
    derivative = np.empty((2, 15))
    for i in range(2):
        gap = in_sensor[2] - in_sensor[0] * points[i, 0] - in_sensor[1] * points[i, 1]
        error[i] = gap / max(length, GRAZING)
        for j in range(15):
            slope = by_tangents[2, j] - by_tangents[0, j] * points[i, 0] - by_tangents[1, j] * points[i, 1]
            derivative[i, j] = slope / max(length, GRAZING)
            if length > GRAZING:
                stretch = in_sensor[0] * by_tangents[0, j] + in_sensor[1] * by_tangents[1, j]
                derivative[i, j] -= gap * stretch / length**3
    return error, derivative


def direction_error(world_T_anchor, world_T_body, coefficients, directions) -> _Error:
    """Components, shape (m,), of a landmark's normal along fixed ``directions`` (m, 3); derivative (m, 15)."""
    seen, jacobian = plane_seen_from(world_T_anchor, world_T_body, coefficients)
    return directions @ seen[:3], directions @ jacobian[:3]


def parallel_error(world_T_anchor, world_T_body, coefficients, reference) -> _Error:
    """Cross product of two normals, shape (3,), of rank 2, smooth everywhere; derivative (3, 18)."""
    seen, jacobian = plane_seen_from(world_T_anchor, world_T_body, coefficients)
    a, b = reference[:3], seen[:3]
    by_seen, by_own = np.zeros((3, 4)), np.zeros((3, 4))
    by_seen[:, :3], by_own[:, :3] = skew(a), -skew(b)
    return skew(a) @ b, _joined(by_seen, jacobian, by_own, a)


def perpendicular_error(world_T_anchor, world_T_body, coefficients, reference) -> _Error:
    """Cosine of the angle between two normals, shape (1,); derivative (1, 18)."""
    seen, jacobian = plane_seen_from(world_T_anchor, world_T_body, coefficients)
    a, b = reference[:3], seen[:3]
    by_seen, by_own = np.array([[*a, 0.0]]), np.array([[*b, 0.0]])
    return np.array([a @ b]), _joined(by_seen, jacobian, by_own, a)


def distance_error(world_T_anchor, world_T_body, coefficients, reference, gap, place) -> _Error:
    """Distance along the reference's normal from it to a parallel plane, less ``gap`` (1,); derivative (1, 18).

    Measured from x, which is ``place`` (3,) dropped onto the reference a: e = sign(a.b) (d_b - b.x) - gap.
    """
    seen, jacobian = plane_seen_from(world_T_anchor, world_T_body, coefficients)
    a, b = reference[:3], seen[:3]
    cosine, height = a @ b, -reference[3] - a @ place
    foot, sign = place + height * a, 1.0 if cosine >= 0.0 else -1.0
    by_seen = sign * np.array([[*-foot, 1.0]])
    by_own = -sign * np.array([[*(height * b - cosine * place), cosine]])
    return sign * (seen[3] - b @ foot) - gap, _joined(by_seen, jacobian, by_own, a)


#: (x.n, y.n, d - n.o) of `plane_error` is (theta, -psi, z): what it takes to (z, theta, psi).
_TO_SP = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))


def map_error(world_T_anchor, world_T_body, *planes_and_frames) -> _Error:
    """(z, theta, psi) of N landmarks against N measured frames, planes first, shape (3 N,); derivative (3 N, 12 + 3 N).

    A map holds in the frame that its landmarks live in: derivatives by poses are left zero.
    """
    count = len(planes_and_frames) // 2
    error, derivative = np.empty(3 * count), np.zeros((3 * count, 12 + 3 * count))
    for i in range(count):
        part, by = plane_error(world_T_anchor, world_T_body, planes_and_frames[i], planes_and_frames[count + i])
        error[3 * i : 3 * i + 3] = _TO_SP @ part
        derivative[3 * i : 3 * i + 3, 12 + 3 * i : 15 + 3 * i] = _TO_SP @ by[:, 12:15]
    return error, derivative


def _joined(by_seen, jacobian, by_own, normal) -> np.ndarray:
    """Chain rule of an error of two planes, the second with that normal in its own frame: derivative (m, 18)."""
    own_jacobian = np.zeros((4, 3))
    own_jacobian[:3, :2], own_jacobian[3, 2] = unit_basis(normal), -1.0
    return np.hstack((by_seen @ jacobian, by_own @ own_jacobian))
