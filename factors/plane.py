"""Factors from SP planes: seen from a pose, or known beforehand."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import gtsam_unstable
import numpy as np

from factors._check import as_key, check_definite
from factors._conventions import (
    centre_root_informations,
    oriented_plane,
    second_order_share,
    square_root_informations,
)
from factors._custom import Recipe
from factors.robust import Robust, gaussian
from spplanes import Plane
from spplanes._check import FloatArray

#: The native factor is used where its second-order error is below this share of a sigma; its mean NIS is then at most
#: 0.045 above 3.
NATIVE_UP_TO = 0.2


def plane_factor(
    plane: Plane, pose_key: int, plane_key: int, *, anchor_key: int | None = None, robust: Robust = None
) -> gtsam.NonlinearFactor:
    """Factor of a plane measured in the frame of the pose ``pose_key``.

    The landmark ``plane_key`` is an ``OrientedPlane3`` in the frame of the pose ``anchor_key``, or in the world without
    one. Anchored is the form to prefer: native, and well conditioned however far from the origin. It is native but for
    two cases: the pose is its own anchor (the first observation), where the factor is unary on the landmark; and small
    patches far away, whose tilt is so uncertain that the native error is not linear within their sigmas.

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
    """Graph of the factors of many planes, each as `plane_factor` makes it, in order; sequences of equal length."""
    anchors: Sequence[int | None] = [None] * len(planes) if anchor_keys is None else anchor_keys
    if not len(planes) == len(pose_keys) == len(plane_keys) == len(anchors):
        raise ValueError(
            f"planes: expected as many as pose_keys, plane_keys and anchor_keys, "
            f"got {len(planes)}, {len(pose_keys)}, {len(plane_keys)}, {len(anchors)}"
        )
    graph = gtsam.NonlinearFactorGraph()
    if not len(planes):
        return graph
    frames, covariances = _stacked(planes)
    roots, centre_roots = square_root_informations(frames, covariances), centre_root_informations(covariances)
    native = second_order_share(frames, covariances) <= NATIVE_UP_TO
    distances = np.einsum("ni,ni->n", frames[:, :3, 2], frames[:, :3, 3])
    for i, (pose, key, anchor) in enumerate(zip(pose_keys, plane_keys, anchors, strict=True)):
        plane_key, pose_key = as_key("plane_key", key), as_key("pose_key", pose)
        anchor_key = None if anchor is None else as_key("anchor_key", anchor)
        if native[i] and anchor_key is not None and anchor_key != pose_key:
            measured, noise = oriented_plane(frames[i, :3, 2], distances[i]), gaussian(roots[i], robust, 3)
            factor = gtsam_unstable.LocalOrientedPlane3Factor(measured, noise, pose_key, anchor_key, plane_key)
        else:
            recipe = Recipe("plane", (frames[i],), centre_roots[i], 3, plane_key, pose_key, anchor_key, robust=robust)
            factor = recipe.factor()
        graph.push_back(factor)
    return graph


def plane_prior(plane: Plane, plane_key: int, *, robust: Robust = None) -> gtsam.CustomFactor:
    """Factor of a plane known beforehand in the frame its landmark lives in (a map, a floor plan).

    Custom, not native: no factor of the wheel acts on an ``OrientedPlane3`` alone but for its direction.
    """
    frames, covariances = _stacked([plane])
    root = centre_root_informations(covariances)[0]
    return Recipe("plane", (frames[0],), root, 3, as_key("plane_key", plane_key), robust=robust).factor()


def _stacked(planes: Sequence[Plane]) -> tuple[FloatArray, FloatArray]:
    covariances = np.stack([plane.covariance for plane in planes])
    check_definite("plane.covariance", covariances)
    return np.stack([plane.frame for plane in planes]), covariances
