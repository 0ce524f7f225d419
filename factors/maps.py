"""Whole maps: how the planes of one hang together, as a covariance and as a prior of another mission."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors._check import as_key, check_distinct
from factors._conventions import hesse_to_sp
from factors._kernels import plane_error, plane_seen_from
from spplanes import Plane
from spplanes._check import FloatArray, as_covariance, as_transform, check_instance

_IDENTITY = np.asfortranarray(np.eye(4))
#: (x.n, y.n, d - n.o) of the kernel is (theta, -psi, z): what it takes to (z, theta, psi).
_TO_SP = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))


def anchored_plane_jacobian(
    landmark: gtsam.OrientedPlane3, world_T_anchor: gtsam.Pose3 | ArrayLike, world_T_plane: ArrayLike
) -> FloatArray:
    """Derivative of a plane's (z, theta, psi) in its frame in the world by the tangents of (anchor, landmark), (3, 9).

    With these of several planes, stacked, and the joint covariance of anchors and landmarks, their covariance in the
    world is J P J^T: what `map_prior` takes.
    """
    check_instance("landmark", landmark, gtsam.OrientedPlane3)
    anchor = as_transform("world_T_anchor", world_T_anchor)
    _, jacobian = plane_seen_from(np.asfortranarray(anchor), _IDENTITY, landmark.planeCoefficients())
    return hesse_to_sp(as_transform("world_T_plane", world_T_plane)) @ jacobian[:, 6:]


def map_prior(planes: Sequence[Plane], plane_keys: Sequence[int], covariance: ArrayLike) -> gtsam.CustomFactor:
    """One factor of all planes of a map known beforehand, in the frame in which their landmarks live.

    Args:
        planes: their frames; their own covariances do not enter.
        plane_keys: the landmarks, ``OrientedPlane3``.
        covariance: of all their perturbations (z, theta, psi), stacked, shape (3 N, 3 N). The planes of a map share the
            errors of the poses they were seen from; taken as independent, their average would look far too sure.

    ValueError: no planes, keys given twice, another shape, a singular covariance.
    """
    keys = [as_key("plane_keys", key) for key in plane_keys]
    if not keys or len(keys) != len(planes):
        raise ValueError(f"planes: expected as many as plane_keys, and at least one, got {len(planes)} and {len(keys)}")
    for plane in planes:
        check_instance("plane", plane, Plane)
    check_distinct(**{f"plane_keys[{i}]": key for i, key in enumerate(keys)})
    full = as_covariance("covariance", covariance, 3 * len(keys))
    try:
        root = np.linalg.inv(np.linalg.cholesky(full))
    except np.linalg.LinAlgError as problem:
        raise ValueError("covariance: expected a positive definite covariance, got a singular one") from problem
    root = np.asarray(np.linalg.qr(root, mode="r"))
    frames = [np.ascontiguousarray(plane.frame) for plane in planes]

    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> FloatArray:
        residual = np.empty(3 * len(keys))
        for i, (key, frame) in enumerate(zip(keys, frames, strict=True)):
            coefficients = values.atOrientedPlane3(key).planeCoefficients()
            part, derivative = plane_error(_IDENTITY, _IDENTITY, coefficients, frame)
            residual[3 * i : 3 * i + 3] = _TO_SP @ part
            if jacobians is not None:
                block = np.zeros((3 * len(keys), 3), order="F")
                block[3 * i : 3 * i + 3] = _TO_SP @ derivative[:, 12:15]
                jacobians[i] = block
        return residual

    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.SqrtInformation(root), keys, error)
