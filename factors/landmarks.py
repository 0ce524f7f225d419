"""Plane landmarks: into the graph, from frame to frame, and out of a solution with their covariance."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gtsam
import gtsam_unstable
import numpy as np
from numpy.typing import ArrayLike
from shapely.affinity import scale

from factors._check import as_keys, held, plane_in, pose_in, told_key
from factors._conventions import hesse_to_sp, landmark_hesse, oriented_plane, plane_frame, tangent_to_sp
from factors._custom import IDENTITY, OF_POSE2, Recipe, describe
from factors._kernels import plane_seen_from
from spplanes import Plane
from spplanes._check import FloatArray, as_covariance, as_shape, as_transform, check_instance


def plane_landmark(plane: Plane, world_T_body: gtsam.Pose3 | ArrayLike | None = None) -> gtsam.OrientedPlane3:
    """Initial value of a landmark from a measured plane.

    Without ``world_T_body`` in the frame of the measurement (an anchored landmark); with it, a pose or (4, 4), in the
    world.
    """
    check_instance("plane", plane, Plane)
    landmark = oriented_plane(plane.normal, plane.d)
    return landmark if world_T_body is None else landmark.transform(_pose("world_T_body", world_T_body).inverse())


def change_anchor(
    landmark: gtsam.OrientedPlane3, world_T_old: gtsam.Pose3 | ArrayLike, world_T_new: gtsam.Pose3 | ArrayLike
) -> gtsam.OrientedPlane3:
    """The same plane in the frame of another anchor; its factors have to be built again with the new ``anchor_key``.

    With covariance: `seen_plane`, then `factors.plane_prior` on the new landmark.
    """
    check_instance("landmark", landmark, gtsam.OrientedPlane3)
    old, new = _pose("world_T_old", world_T_old), _pose("world_T_new", world_T_new)
    return landmark.transform(old.between(new))


def facing(plane: Plane, viewpoint: ArrayLike) -> Plane:
    """The plane with its normal toward ``viewpoint`` (3,), in the frame the plane is in.

    Turned about its x axis by pi where need be: z, theta and the outline's y change sign, psi does not.
    """
    check_instance("plane", plane, Plane)
    if plane.normal @ as_shape("viewpoint", viewpoint, (3,)) >= plane.d:
        return plane
    signs = np.array([-1.0, -1.0, 1.0])
    outline = None if plane.outline is None else scale(plane.outline, yfact=-1.0, origin=(0.0, 0.0))
    frame = plane.frame @ np.diag([1.0, -1.0, -1.0, 1.0])
    return replace(plane, frame=frame, covariance=plane.covariance * np.outer(signs, signs), outline=outline)


def landmark_anchors(graph: gtsam.NonlinearFactorGraph) -> dict[int, int | None]:
    """Anchor pose of every plane landmark of a graph, None for the world, by the landmark's key.

    GTSAM cannot see the mistake of a landmark that one factor takes in the world and another in the frame of a pose: it
    solves, for something else. Here it is refused; call it once before optimising. What is known of directions and of
    pairs of planes counts as well: without an anchor it is of landmarks in the world. Landmarks that have nothing but a
    `plane_prior` or a `map_prior`, which hold in whatever frame they live in, are left out.

    ValueError: a landmark with two anchors, or with one and in the world; the sentence names it and both.
    """
    check_instance("graph", graph, gtsam.NonlinearFactorGraph)
    anchors: dict[int, int | None] = {}
    for i in range(graph.size()):
        if not graph.exists(i):
            continue
        for plane_key, anchor_key in _anchorings(graph.at(i)):
            check_anchor("graph", anchors, plane_key, anchor_key)
    return anchors


def check_anchor(name: str, anchors: dict[int, int | None], plane_key: int, anchor_key: int | None) -> None:
    """Take down the anchor of a landmark; refuse another one than it has."""
    known = anchors.setdefault(plane_key, anchor_key)
    if known != anchor_key:
        raise ValueError(
            f"{name}: expected one anchor for each landmark, got two for {told_key(plane_key)}: "
            f"{_told(known)} and {_told(anchor_key)}"
        )


def _anchorings(factor: Any) -> list[tuple[int, int | None]]:
    """(plane, anchor) of every landmark of which a factor says in whose frame it lives."""
    keys = list(factor.keys())
    if isinstance(factor, gtsam_unstable.LocalOrientedPlane3Factor):
        return [(keys[2], keys[1])]
    if isinstance(factor, gtsam.OrientedPlane3Factor | gtsam.OrientedPlane3DirectionPrior):
        return [(keys[-1], None)]
    recipe = describe(factor)
    if not isinstance(recipe, Recipe):
        return []
    if recipe.kernel in ("plane", "map") and recipe.pose_key is recipe.anchor_key is None:
        return []
    own = [(recipe.plane_key, recipe.anchor_key)]
    return own if recipe.reference_key is None else [*own, (recipe.reference_key, recipe.pose_key)]


def _told(anchor_key: int | None) -> str:
    return "the world" if anchor_key is None else told_key(anchor_key)


def landmark_to_plane(
    landmark: gtsam.OrientedPlane3, covariance: ArrayLike, *, centre: ArrayLike | None = None, n_points: int = 0
) -> Plane:
    """SP plane of a landmark with its marginal ``covariance`` (3, 3) in GTSAM's tangent.

    The frame's origin is ``centre`` (3,) dropped onto the plane; without it the foot of the perpendicular from the
    origin. Its x axis is arbitrary.
    """
    frame = plane_frame(*landmark_hesse(landmark), _centre(centre))
    to_sp = tangent_to_sp(frame)
    own = to_sp @ as_covariance("covariance", covariance, 3) @ to_sp.T
    return Plane(frame=frame, covariance=own, n_points=n_points)


def world_plane(
    values: gtsam.Values,
    marginals: gtsam.Marginals,
    plane_key: int,
    *,
    anchor_key: int | None = None,
    centre: ArrayLike | None = None,
    n_points: int = 0,
    shape_of: Plane | None = None,
) -> Plane:
    """Landmark of a solution as a plane in the world, with covariance.

    An anchored landmark is uncertain in its anchor's frame and moves with the anchor: the covariance is that of the
    joint marginal of both. ``centre`` (3,) in the world, as in `landmark_to_plane`. ``shape_of`` is a plane about where
    the landmark is, such as a measured one moved by ``plane.transform(pose)``: the result has its outline, its
    n_points, and its frame moved onto the landmark by the shortest way. ValueError: it has no ``outline``.
    """
    landmark = plane_in("plane_key", values, plane_key)
    around = centre if shape_of is None else shape_of.centre
    if anchor_key is None:
        covariance = joint_covariance(marginals, [plane_key])
        found = landmark_to_plane(landmark, covariance, centre=around, n_points=n_points)
    else:
        anchor = pose_in("anchor_key", values, anchor_key)
        joint = _joint(values, marginals, [anchor_key], plane_key)
        found = world_plane_from_joint(landmark, anchor, joint, centre=around, n_points=n_points)
    return found if shape_of is None else _shaped(found, shape_of)


def world_plane_from_joint(
    landmark: gtsam.OrientedPlane3,
    world_T_anchor: gtsam.Pose3 | ArrayLike,
    joint: ArrayLike,
    *,
    centre: ArrayLike | None = None,
    n_points: int = 0,
) -> Plane:
    """As `world_plane`, from the joint covariance (9, 9) of (anchor pose, landmark), both in GTSAM's tangents."""
    check_instance("landmark", landmark, gtsam.OrientedPlane3)
    pose = _pose("world_T_anchor", world_T_anchor).matrix()
    seen, jacobian = plane_seen_from(pose, IDENTITY, landmark.planeCoefficients())
    return _with_joint(seen, jacobian[:, 6:], as_covariance("joint", joint, 9), centre, n_points)


def seen_plane(
    values: gtsam.Values,
    marginals: gtsam.Marginals,
    plane_key: int,
    pose_key: int,
    *,
    anchor_key: int | None = None,
    centre: ArrayLike | None = None,
    n_points: int = 0,
) -> Plane:
    """Landmark of a solution in the frame of the pose ``pose_key``, with the covariance of the joint marginal.

    What that pose expects to see, for gating a measurement; or the landmark in a new anchor's frame. ``centre`` (3,) in
    that frame.
    """
    landmark, pose = plane_in("plane_key", values, plane_key), pose_in("pose_key", values, pose_key).matrix()
    if anchor_key == pose_key:
        own = joint_covariance(marginals, [plane_key])
        return landmark_to_plane(landmark, own, centre=centre, n_points=n_points)
    pose_keys, anchor = [pose_key], IDENTITY
    if anchor_key is not None:
        pose_keys, anchor = [pose_key, anchor_key], pose_in("anchor_key", values, anchor_key).matrix()
    seen, jacobian = plane_seen_from(anchor, pose, landmark.planeCoefficients())
    if anchor_key is None:
        jacobian = np.delete(jacobian, np.s_[6:12], axis=1)
    return _with_joint(seen, jacobian, _joint(values, marginals, pose_keys, plane_key), centre, n_points)


def joint_covariance(marginals: gtsam.Marginals, keys: list[int]) -> FloatArray:
    """Joint covariance of several variables in the order of ``keys``; ValueError: keys twice or without a marginal."""
    check_instance("marginals", marginals, gtsam.Marginals)
    names = as_keys("keys", keys)
    try:
        if len(names) == 1:
            return np.asarray(marginals.marginalCovariance(names[0]))
        return marginals.jointMarginalCovariance(names).fullMatrix()
    except (IndexError, RuntimeError) as error:  # map::at
        missing = [told_key(key) for key in names if held(marginals.marginalCovariance, key) is None]
        if not missing:
            raise
        told = ", ".join(missing)
        raise ValueError(f"keys: expected variables of the graph that the marginals are of, got {told}") from error


def _joint(values: gtsam.Values, marginals: gtsam.Marginals, pose_keys: list[int], plane_key: int) -> FloatArray:
    """Joint covariance of poses and a plane; a Pose2 has no error out of its plane, 6 numbers as any."""
    known = [range(6) if held(values.atPose2, key) is None else OF_POSE2 for key in pose_keys]
    rows = [6 * i + row for i, own in enumerate([*known, range(3)]) for row in own]
    full = np.zeros((6 * len(pose_keys) + 3,) * 2)
    full[np.ix_(rows, rows)] = joint_covariance(marginals, [*pose_keys, plane_key])
    return full


def _with_joint(
    seen: FloatArray, jacobian: FloatArray, joint: FloatArray, centre: ArrayLike | None, n_points: int
) -> Plane:
    """Plane of a Hesse row (4,) that depends by ``jacobian`` (4, n) on variables of covariance ``joint`` (n, n)."""
    frame = plane_frame(seen[:3], float(seen[3]), _centre(centre))
    to_sp = hesse_to_sp(frame) @ jacobian
    return Plane(frame=frame, covariance=to_sp @ joint @ to_sp.T, n_points=n_points)


def _shaped(plane: Plane, shape: Plane) -> Plane:
    """The plane in axes that are those of `shape` projected onto it, with its outline and number of points."""
    check_instance("shape_of", shape, Plane)
    if shape.outline is None:
        raise ValueError("shape_of: expected a plane with an outline, got one without")
    if plane.normal @ shape.normal <= 0.0:
        raise ValueError("shape_of: expected a plane that faces the way of the landmark, got one that does not")
    frame = plane.frame.copy()
    x = shape.frame[:3, 0] - (shape.frame[:3, 0] @ plane.normal) * plane.normal
    frame[:3, 0] = x / np.linalg.norm(x)
    frame[:3, 1] = np.cross(plane.normal, frame[:3, 0])
    # a turn about the normal: n as a function of (theta, psi) is n + theta x - psi y
    c, s = frame[:3, 0] @ plane.frame[:3, 0], frame[:3, 0] @ plane.frame[:3, 1]
    turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
    covariance = turn @ plane.covariance @ turn.T
    return Plane(frame, 0.5 * (covariance + covariance.T), shape.n_points, shape.outline)


def _centre(centre: ArrayLike | None) -> FloatArray:
    return np.zeros(3) if centre is None else as_shape("centre", centre, (3,))


def _pose(name: str, value: gtsam.Pose3 | ArrayLike) -> gtsam.Pose3:
    return value if isinstance(value, gtsam.Pose3) else gtsam.Pose3(as_transform(name, value))
