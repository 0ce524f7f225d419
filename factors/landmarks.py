"""Plane landmarks: into the graph, and out of a solution with their covariance."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors._conventions import as_pose3, hesse, oriented_plane, tangent_to_sp
from factors._kernels import plane_seen_from
from spplanes import Plane
from spplanes._check import FloatArray, as_covariance, as_shape, as_transform

_IDENTITY = np.asfortranarray(np.eye(4))


def plane_landmark(plane: Plane, world_T_body: gtsam.Pose3 | ArrayLike | None = None) -> gtsam.OrientedPlane3:
    """Initial value of a landmark from a measured plane.

    Without ``world_T_body`` in the frame of the measurement (an anchored landmark); with it in the world.
    """
    landmark = oriented_plane(plane.normal, plane.d)
    if world_T_body is None:
        return landmark
    return landmark.transform(_pose(world_T_body).inverse())


def landmark_to_plane(
    landmark: gtsam.OrientedPlane3, covariance: ArrayLike, *, centre: ArrayLike | None = None, n_points: int = 0
) -> Plane:
    """SP plane of a landmark with its marginal ``covariance`` (3, 3) in GTSAM's tangent.

    The frame's origin is ``centre`` (3,) dropped onto the plane; without it the foot of the perpendicular from the
    origin. Its x axis is arbitrary.
    """
    normal, d = hesse(landmark)
    frame = plane_frame(normal, d, np.zeros(3) if centre is None else as_shape("centre", centre, (3,)))
    to_sp = tangent_to_sp(frame)
    return Plane(
        frame=frame, covariance=to_sp @ as_covariance("covariance", covariance, 3) @ to_sp.T, n_points=n_points
    )


def world_plane(
    values: gtsam.Values,
    marginals: gtsam.Marginals,
    plane_key: int,
    *,
    anchor_key: int | None = None,
    centre: ArrayLike | None = None,
    n_points: int = 0,
) -> Plane:
    """Landmark of a solution as a plane in the world, with covariance.

    An anchored landmark is uncertain in its anchor's frame and moves with the anchor: the covariance is that of the
    joint marginal of both. ``centre`` (3,) in the world, as in `landmark_to_plane`.
    """
    landmark = values.atOrientedPlane3(plane_key)
    if anchor_key is None:
        covariance = marginals.marginalCovariance(plane_key)
        return landmark_to_plane(landmark, covariance, centre=centre, n_points=n_points)
    joint = joint_covariance(marginals, [anchor_key, plane_key])
    return world_plane_from_joint(landmark, values.atPose3(anchor_key), joint, centre=centre, n_points=n_points)


def world_plane_from_joint(
    landmark: gtsam.OrientedPlane3,
    world_T_anchor: gtsam.Pose3,
    joint: FloatArray,
    *,
    centre: ArrayLike | None = None,
    n_points: int = 0,
) -> Plane:
    """As `world_plane`, from the joint covariance (9, 9) of (anchor pose, landmark), both in GTSAM's tangents."""
    derivative = plane_seen_from(world_T_anchor.matrix(), _IDENTITY, landmark.planeCoefficients())
    seen, jacobian = derivative
    frame = plane_frame(seen[:3], seen[3], np.zeros(3) if centre is None else as_shape("centre", centre, (3,)))
    to_sp = hesse_to_sp(frame) @ jacobian[:, 6:]
    covariance = to_sp @ as_covariance("joint", joint, 9) @ to_sp.T
    return Plane(frame=frame, covariance=covariance, n_points=n_points)


def joint_covariance(marginals: gtsam.Marginals, keys: list[int]) -> FloatArray:
    """Joint covariance of several variables in the order of ``keys``."""
    joint = marginals.jointMarginalCovariance(keys)
    return np.block([[joint.at(row, column) for column in keys] for row in keys])


def plane_frame(normal: FloatArray, d: float, centre: FloatArray) -> FloatArray:
    """Plane frame, shape (4, 4), with its origin at ``centre`` (3,) dropped onto the plane and an arbitrary x axis."""
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


def _pose(value: gtsam.Pose3 | ArrayLike) -> gtsam.Pose3:
    return value if isinstance(value, gtsam.Pose3) else as_pose3(as_transform("world_T_body", value))
