"""Factors from SP planes: seen from a pose, or known beforehand."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import gtsam_unstable
import numpy as np

from factors._check import as_key, check_definite
from factors._conventions import oriented_plane, square_root_informations
from factors._custom import Recipe
from factors._kernels import unit_basis
from factors.robust import Robust, gaussian
from spplanes import Plane
from spplanes._check import FloatArray


def plane_factor(
    plane: Plane, pose_key: int, plane_key: int, *, anchor_key: int | None = None, robust: Robust = None
) -> gtsam.NonlinearFactor:
    """Factor of a plane measured in the frame of the pose ``pose_key``.

    The landmark ``plane_key`` is an ``OrientedPlane3`` in the frame of the pose ``anchor_key``, or in the world without
    one. Anchored is the form to prefer: it is native, and well conditioned however far from the origin. Where the pose
    is its own anchor (the first observation) the factor is unary on the landmark. The error is
    [B^T n_predicted, d_predicted - d_measured] with B the tangent basis of the measured normal.

    Sides are the caller's: the error is blind to a plane seen from behind (see `factors.facing`).
    ValueError: a key that is no integer, a singular covariance, an unknown kernel.
    """
    keys = ([pose_key], [plane_key], None if anchor_key is None else [anchor_key])
    return plane_factors([plane], *keys, robust=robust).at(0)


def plane_factors(
    planes: Sequence[Plane],
    pose_keys: Sequence[int],
    plane_keys: Sequence[int],
    anchor_keys: Sequence[int] | None = None,
    *,
    robust: Robust = None,
) -> gtsam.NonlinearFactorGraph:
    """Graph of the factors of many planes, as `plane_factor` makes one; sequences of equal length."""
    anchors: Sequence[int | None] = [None] * len(planes) if anchor_keys is None else anchor_keys
    if not len(planes) == len(pose_keys) == len(plane_keys) == len(anchors):
        raise ValueError(
            f"planes: expected as many as pose_keys, plane_keys and anchor_keys, "
            f"got {len(planes)}, {len(pose_keys)}, {len(plane_keys)}, {len(anchors)}"
        )
    graph = gtsam.NonlinearFactorGraph()
    if not len(planes):
        return graph
    frames = np.stack([plane.frame for plane in planes])
    covariances = np.stack([plane.covariance for plane in planes])
    check_definite("plane.covariance", covariances)
    roots = square_root_informations(frames, covariances)
    for frame, root, pose, key, anchor in zip(frames, roots, pose_keys, plane_keys, anchors, strict=True):
        anchor = None if anchor is None else as_key("anchor_key", anchor)
        graph.push_back(_one(frame, root, as_key("pose_key", pose), as_key("plane_key", key), anchor, robust))
    return graph


def plane_prior(plane: Plane, plane_key: int, *, robust: Robust = None) -> gtsam.CustomFactor:
    """Factor of a plane known beforehand in the frame its landmark lives in (a map, a floor plan).

    Custom, not native: no factor of the wheel acts on an ``OrientedPlane3`` alone but for its direction.
    """
    check_definite("plane.covariance", plane.covariance[None])
    root = square_root_informations(plane.frame[None], plane.covariance[None])[0]
    return _recipe(plane.frame, root, None, as_key("plane_key", plane_key), None, robust).factor()


def _one(
    frame: FloatArray, root: FloatArray, pose_key: int, plane_key: int, anchor_key: int | None, robust: Robust
) -> gtsam.NonlinearFactor:
    if anchor_key is None or anchor_key == pose_key:
        return _recipe(frame, root, pose_key, plane_key, anchor_key, robust).factor()
    measured = oriented_plane(frame[:3, 2], float(frame[:3, 2] @ frame[:3, 3]))
    noise = gaussian(root, robust, 3)
    return gtsam_unstable.LocalOrientedPlane3Factor(measured, noise, pose_key, anchor_key, plane_key)


def _recipe(
    frame: FloatArray, root: FloatArray, pose_key: int | None, plane_key: int, anchor_key: int | None, robust: Robust
) -> Recipe:
    normal = np.ascontiguousarray(frame[:3, 2])
    data = (unit_basis(normal), float(normal @ frame[:3, 3]))
    return Recipe("plane", data, root, 3, plane_key, pose_key, anchor_key, robust=robust)
