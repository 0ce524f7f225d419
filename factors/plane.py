"""Factors from SP planes: seen from a pose, or known beforehand, one or a whole map of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import gtsam
import gtsam_unstable
import numpy as np
from numpy.typing import ArrayLike

from factors._check import as_anchor, as_key, as_keys, as_list, check_definite, check_distinct
from factors._conventions import (
    centre_root_informations,
    hesse_to_sp,
    oriented_plane,
    second_order,
    square_root_informations,
)
from factors._custom import IDENTITY, Recipe
from factors._kernels import plane_seen_from
from factors.landmarks import check_anchor
from factors.robust import Robust, gaussian
from spplanes import Plane
from spplanes._check import FloatArray, as_covariance, as_transform, check_instance


def plane_factor(
    plane: Plane, pose_key: int, plane_key: int, *, anchor_key: int | None = None, robust: Robust = None
) -> gtsam.NonlinearFactor:
    """Factor of a plane measured in the frame of the pose ``pose_key``.

    The landmark ``plane_key`` is an ``OrientedPlane3`` in the frame of the pose ``anchor_key``, or in the world without
    one. Anchored is the form to prefer: native, and well conditioned however far from the origin. Where the pose is its
    own anchor (the first observation) the factor is unary on the landmark and, as in the world, custom: GTSAM would
    count the pose's information twice over. An optimiser copies all its values at every call of a custom factor: in
    graphs of thousands of variables anchor landmarks at another pose than the first observer, such as the keyframe
    before it, or every thirtieth keyframe.

    The native error is not quite linear in the tilts: at the distance d of the plane a tilt e takes d |e|^2 / 2 off.
    Its mean and variance under the plane's own covariance are corrected for, which matters to small patches far away.

    Sides are the caller's (`factors.facing`): of a plane whose normal points away from the landmark's the native error
    is twice its distance, the custom one nothing. All factors of one landmark take it in one frame:
    `factors.landmark_anchors` refuses a graph where they do not.

    GTSAM cannot clone these factors: ``graph.clone()``, ``rekey`` and its ``GncOptimizer`` do not take them, ``robust``
    and `factors.archive.rekeyed` do what those do. Its own archives lose what a native factor measured: ``copy`` and
    ``pickle`` of a factor are right wherever `factors` was imported, graphs go through `factors.archive.dumps` and
    `loads`, or `factors.copy_graph`.
    ValueError: a key that is no integer, a singular covariance, an unknown kernel.
    """
    get_ready([plane])
    return _ready[plane].factor(pose_key, plane_key, anchor_key, robust)


def get_ready(planes: Sequence[Plane]) -> None:
    """Work out what factors of these planes have in common, once and together, for the calls of `plane_factor` to come.

    A plane is compared with many landmarks before it is in the graph once. ValueError: a singular covariance.
    """
    if new := [plane for plane in _as_planes(planes) if plane not in _ready]:
        _ready.update(zip(new, _measured(new), strict=True))


def plane_factors(
    planes: Sequence[Plane],
    pose_keys: Sequence[int],
    plane_keys: Sequence[int],
    anchor_keys: Sequence[int] | None = None,
    *,
    robust: Robust = None,
) -> gtsam.NonlinearFactorGraph:
    """Graph of the factors of many planes, each as `plane_factor` makes it, in order; sequences of equal length."""
    planes = _as_planes(planes)
    pose_keys, plane_keys = as_list("pose_keys", pose_keys), as_list("plane_keys", plane_keys)
    anchors: Sequence[int | None] = [None] * len(planes) if anchor_keys is None else anchor_keys
    if not len(planes) == len(pose_keys) == len(plane_keys) == len(anchors):
        raise ValueError(
            f"planes: expected as many as pose_keys, plane_keys and anchor_keys, "
            f"got {len(planes)}, {len(pose_keys)}, {len(plane_keys)}, {len(anchors)}"
        )
    graph = gtsam.NonlinearFactorGraph()
    if not len(planes):
        return graph
    known: dict[int, int | None] = {}
    for one, pose, key, anchor in zip(_measured(planes), pose_keys, plane_keys, anchors, strict=True):
        anchor_key = as_anchor("anchor_keys", anchor)
        check_anchor("anchor_keys", known, as_key("plane_keys", key), anchor_key)
        graph.push_back(one.factor(pose, key, anchor, robust))
    return graph


@dataclass(frozen=True, eq=False)
class _Measured:
    """What a plane's factors have in common, whatever they are between."""

    frame: FloatArray
    distance: float
    root: FloatArray
    centre_root: FloatArray

    def factor(self, pose: int, key: int, anchor: int | None, robust: Robust) -> gtsam.NonlinearFactor:
        """The factor between these keys."""
        plane_key, pose_key = as_key("plane_key", key), as_key("pose_key", pose)
        anchor_key = as_anchor("anchor_key", anchor)
        if plane_key in (pose_key, anchor_key):
            check_distinct(pose_key=pose_key, plane_key=plane_key)
            check_distinct(anchor_key=anchor_key, plane_key=plane_key)
        if anchor_key is not None and anchor_key != pose_key:
            measured, noise = oriented_plane(self.frame[:3, 2], self.distance), gaussian(self.root, robust, 3)
            return gtsam_unstable.LocalOrientedPlane3Factor(measured, noise, pose_key, anchor_key, plane_key)
        recipe = Recipe("plane", (self.frame,), self.centre_root, 3, plane_key, pose_key, anchor_key, robust=robust)
        return recipe.factor()


#: Of planes, by identity, for as long as they are there.
_ready: WeakKeyDictionary[Plane, _Measured] = WeakKeyDictionary()


def _measured(planes: Sequence[Plane]) -> list[_Measured]:
    frames, covariances = _stacked(planes)
    mean, variance = second_order(frames, covariances)
    distances = np.einsum("ni,ni->n", frames[:, :3, 2], frames[:, :3, 3]) + mean
    inflated = covariances.copy()
    inflated[:, 0, 0] += variance
    roots, centre_roots = square_root_informations(frames, inflated), centre_root_informations(covariances)
    return [_Measured(*one) for one in zip(frames, distances.tolist(), roots, centre_roots, strict=True)]


def plane_prior(plane: Plane, plane_key: int, *, robust: Robust = None) -> gtsam.CustomFactor:
    """Factor of a plane known beforehand in the frame its landmark lives in (a map, a floor plan).

    Custom, not native: no factor of the wheel acts on an ``OrientedPlane3`` alone but for its direction.
    """
    frames, covariances = _stacked(_as_planes([plane]))
    root = centre_root_informations(covariances)[0]
    return Recipe("plane", (frames[0],), root, 3, as_key("plane_key", plane_key), robust=robust).factor()


def _as_planes(value: Sequence[Plane]) -> list[Plane]:
    planes = as_list("planes", value)
    for plane in planes:
        check_instance("plane", plane, Plane)
    return planes


def _stacked(planes: Sequence[Plane]) -> tuple[FloatArray, FloatArray]:
    covariances = np.stack([plane.covariance for plane in planes])
    check_definite("plane.covariance", covariances)
    return np.stack([plane.frame for plane in planes]), covariances


def anchored_plane_jacobian(
    landmark: gtsam.OrientedPlane3, world_T_anchor: gtsam.Pose3 | ArrayLike, world_T_plane: ArrayLike
) -> FloatArray:
    """Derivative of a plane's (z, theta, psi) in its frame in the world by the tangents of (anchor, landmark), (3, 9).

    With these of several planes, stacked, and the joint covariance of anchors and landmarks, their covariance in the
    world is J P J^T: what `map_prior` takes.
    """
    check_instance("landmark", landmark, gtsam.OrientedPlane3)
    anchor = as_transform("world_T_anchor", world_T_anchor)
    _, jacobian = plane_seen_from(np.asfortranarray(anchor), IDENTITY, landmark.planeCoefficients())
    return hesse_to_sp(as_transform("world_T_plane", world_T_plane)) @ jacobian[:, 6:]


def map_prior(
    planes: Sequence[Plane], plane_keys: Sequence[int], covariance: ArrayLike, *, robust: Robust = None
) -> gtsam.CustomFactor:
    """One factor of all planes of a map known beforehand, in the frame in which their landmarks live.

    Args:
        planes: their frames; their own covariances do not enter.
        plane_keys: the landmarks, ``OrientedPlane3``.
        covariance: of all their perturbations (z, theta, psi), stacked, shape (3 N, 3 N). The planes of a map share the
            errors of the poses they were seen from; taken as independent, their average would look far too sure.

    ValueError: no planes, keys given twice, another shape, a singular covariance.
    """
    planes, keys = _as_planes(planes), as_list("plane_keys", plane_keys)
    if not keys or len(keys) != len(planes):
        raise ValueError(f"planes: expected as many as plane_keys, and at least one, got {len(planes)} and {len(keys)}")
    keys = as_keys("plane_keys", keys)
    full = as_covariance("covariance", covariance, 3 * len(keys))
    try:
        root = np.linalg.inv(np.linalg.cholesky(full))
    except np.linalg.LinAlgError as problem:
        raise ValueError("covariance: expected a positive definite covariance, got a singular one") from problem
    root = np.asarray(np.linalg.qr(root, mode="r"))
    frames, (first, *others) = tuple(plane.frame.copy() for plane in planes), keys
    second, more = (others[0] if others else None), tuple(others[1:])
    recipe = Recipe("map", frames, root, len(root), first, reference_key=second, more_keys=more, robust=robust)
    return recipe.factor()
