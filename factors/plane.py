"""Factors from SP planes: seen from a pose, or known beforehand."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import gtsam_unstable
import numpy as np

from factors._check import as_definite_covariance, as_key
from factors._conventions import hesse, oriented_plane, square_root_informations
from factors._custom import landmark_factor
from factors._kernels import plane_error, unit_basis
from factors.robust import Robust, with_robust
from spplanes import Plane


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
    covariances = np.stack([as_definite_covariance("plane.covariance", plane.covariance, 3) for plane in planes])
    roots = square_root_informations(frames, covariances)
    for frame, root, pose, key, anchor in zip(frames, roots, pose_keys, plane_keys, anchors, strict=True):
        noise = with_robust(gtsam.noiseModel.Gaussian.SqrtInformation(root, False), robust, 3)
        graph.push_back(_one(frame, noise, as_key("pose_key", pose), as_key("plane_key", key), anchor))
    return graph


def plane_prior(plane: Plane, plane_key: int, *, robust: Robust = None) -> gtsam.NonlinearFactor:
    """Factor of a plane known beforehand in the frame its landmark lives in (a map, a floor plan)."""
    key = as_key("plane_key", plane_key)
    return plane_factors([plane], [key], [key], [key], robust=robust).at(0)


def _one(
    frame: np.ndarray, noise: gtsam.noiseModel.Base, pose_key: int, plane_key: int, anchor_key: int | None
) -> gtsam.NonlinearFactor:
    measured = oriented_plane(frame[:3, 2], float(frame[:3, 2] @ frame[:3, 3]))
    if anchor_key is not None and as_key("anchor_key", anchor_key) != pose_key:
        return gtsam_unstable.LocalOrientedPlane3Factor(measured, noise, pose_key, anchor_key, plane_key)
    normal, distance = hesse(measured)
    data = (unit_basis(np.ascontiguousarray(normal)), distance)
    return landmark_factor(plane_error, data, noise, plane_key, pose_key, anchor_key)
