"""The information that an observation of a known plane gives on the pose it was seen from."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from factors.association.observations import LineObservation, Observation
from slam.frontend.odometry import NO_FLOOR, Motion
from spplanes._check import FloatArray
from spplanes.spmodel import skew

#: Information about a motion, 1 / m^2 and 1 / rad^2, that stands for none.
_NO_INFORMATION = 1e-2


def plane_information(observation: Observation, normal: FloatArray | None = None) -> FloatArray:
    """Information (6, 6) that seeing a known plane gives on the pose, tangent (rx, ry, rz, x, y, z) of the body.

    A pose moved by (w, t) on the body's side sees the plane's normal n turned by n x w and the plane, at its centre c,
    moved along n by -n.t - w.(c x n); SP: theta = x.dn, psi = -y.dn. A line says nothing on the tilt about itself.

    Args:
        observation: the plane as it was seen.
        normal: the known plane's, in the body, (3,); None: as seen. Looks at one wall differ in direction by their
            noise, and would seem to fix between them what slides along it.
    """
    plane = observation.full_plane(1.0)
    x_axis, y_axis, seen = plane.frame[:3, :3].T
    if normal is not None:
        x_axis = x_axis - normal * (normal @ x_axis)
        x_axis = x_axis / np.linalg.norm(x_axis)
        y_axis = skew(normal) @ x_axis
    facing: FloatArray = seen if normal is None else normal
    jacobian = np.zeros((3, 6))
    jacobian[0, :3], jacobian[0, 3:] = skew(facing) @ plane.centre, -facing
    jacobian[1, :3] = -y_axis  # x cross n
    jacobian[2, :3] = -x_axis  # n cross y
    told = 2 if isinstance(observation, LineObservation) else 3
    return jacobian[:told].T @ np.linalg.solve(plane.covariance[:told, :told], jacobian[:told])


#: That of observations as they were seen: what a keyframe saw is asked for several times.
information_as_seen = lru_cache(maxsize=64)(plane_information)


def floor_information(motion: Motion | None) -> FloatArray:
    """Information (6, 6) of (rotation, translation) in the body by the floor that it drives on; none off a floor."""
    information = np.zeros((6, 6))
    if motion is not None and motion.is_planar:
        z, roll, pitch = motion.out_of_plane_sigmas
        for axis, sigma in ((0, roll), (1, pitch), (5, z)):
            information[axis, axis] = max(sigma, 1e-6) ** -2  # finite where a rig states 0
    return information


def information_beyond_lines(motion: Motion, lines: Sequence[Observation]) -> Motion | None:
    """What the returns say of a motion beyond lines of known walls seen at its end, as a motion; None: nothing.

    These lines are measurements of their own in the graph, of the same returns: what they say is taken off. A line of
    no known wall says nothing of the motion yet.
    """
    if motion.returns_a_T_b is None or motion.returns_covariance is None:
        return None
    turn = np.eye(3)
    turn[:2, :2] = motion.returns_a_T_b[:2, :2]
    told = sum(map(information_as_seen, lines), np.zeros((6, 6)))[np.ix_((3, 4, 2), (3, 4, 2))]  # of x, y, theta
    by_lines = turn @ told @ turn.T + _NO_INFORMATION * np.eye(3)
    covariance = left_open(motion.returns_covariance, inverted(by_lines))
    if covariance is None:
        return None
    return Motion(motion.returns_a_T_b, covariance, NO_FLOOR)


def left_open(found: FloatArray, by_walls: FloatArray) -> FloatArray | None:
    """Covariance of what returns say of a motion beyond what the matched walls say of it already; None: nothing.

    The walls' factors are in the graph, and come from the same returns. Along a corridor they say nothing, door frames
    and corners do. In the axes in which both covariances (3, 3) of (x, y, theta) are diagonal, information of the walls
    is taken off; theirs is large where they leave it open.
    """
    values, vectors = np.linalg.eigh(found)
    root = vectors / np.sqrt(values)  # information = root root^T
    shares, axes = np.linalg.eigh(np.linalg.inv(root) @ np.linalg.inv(by_walls) @ np.linalg.inv(root).T)
    gained = np.maximum(1.0 - shares, 0.0)
    if gained.max() < 0.5:  # too small a share of what the walls say
        return None
    turned = root @ axes
    values, vectors = np.linalg.eigh((turned * gained) @ turned.T + _NO_INFORMATION * np.eye(3))
    return (vectors / np.maximum(values, _NO_INFORMATION)) @ vectors.T


def positive(matrix: FloatArray) -> FloatArray:
    """The nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def inverted(matrix: FloatArray) -> FloatArray:
    """The inverse of a covariance, or of information."""
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)
