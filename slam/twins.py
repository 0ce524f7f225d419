"""Landmarks that turn out to be one plane."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np
from scipy.stats import chi2 as chi2_distribution

from factors import landmark_hesse
from slam.backend import Backend
from slam.config import AssociationConfig
from slam.frames import inverse
from slam.landmarks import Landmark, LandmarkMap, PlacedPlane
from slam.outlines import flatten
from spplanes._check import FloatArray

#: Step of the central differences, rad and m: far below any sigma here, far above rounding.
_STEP = 1e-6


def find_twins(
    touched: Iterable[int],
    landmarks: LandmarkMap,
    backend: Backend,
    config: AssociationConfig,
    *,
    min_keyframes: int,
) -> list[tuple[int, int]]:
    """Pairs (older, younger) of landmarks that are one plane by chi2 with the covariance of the whole state.

    Args:
        touched: ids of landmarks whose estimate or outline has just changed; only pairs with one of them are looked at.
        landmarks, backend, config: the map, as of its last refresh.
        min_keyframes: landmarks seen from fewer are left alone: what one look says may be wrong, a merge would keep it.

    Returns:
        Disjoint pairs, best first.
    """
    limit = float(chi2_distribution.isf(config.significance, 3))
    wanted = set(touched)
    found: list[tuple[float, int, int]] = []
    placed = [(one, place) for one, place in landmarks.placements() if one.n_keyframes >= min_keyframes]
    for index, (first, first_place) in enumerate(placed):
        for second, second_place in placed[index + 1 :]:
            if first.id not in wanted and second.id not in wanted:
                continue
            if not _may_be_one(first, first_place, second, second_place, config):
                continue
            chi2 = twin_chi2(first, second, backend)
            if chi2 <= limit:
                found.append((chi2, first.id, second.id))
    return _disjoint(sorted(found))


def twin_chi2(first: Landmark, second: Landmark, backend: Backend) -> float:
    """Squared Mahalanobis distance of two landmarks of one state, chi2 with 3 degrees of freedom if they are one.

    Their difference is taken in the frame of the second's anchor, in a basis that stays fixed: that of
    ``Unit3.basis()`` jumps where components of the normal tie.
    """
    keys = list(dict.fromkeys((first.anchor_key, first.key, second.anchor_key, second.key)))
    values = gtsam.Values()
    for key in (first.anchor_key, second.anchor_key):
        if not values.exists(key):
            values.insert(key, backend.values.atPose3(key))
    values.insert(first.key, backend.plane(first.key))
    values.insert(second.key, backend.plane(second.key))
    basis = backend.plane(second.key).normal().basis()
    difference = _difference(values, first, second, basis)
    jacobian = np.hstack([_derivative(values, key, first, second, basis) for key in keys])
    covariance = jacobian @ backend.joint_covariance(keys).of(keys) @ jacobian.T
    return float(difference @ np.linalg.solve(covariance, difference))


def _may_be_one(
    first: Landmark, first_place: PlacedPlane, second: Landmark, second_place: PlacedPlane, config: AssociationConfig
) -> bool:
    """Same side, similar direction, patches near each other along the plane and across it."""
    if first_place.normal @ second_place.normal < np.cos(config.max_angle_rad):
        return False
    first_T_second = inverse(first_place.world_T_plane) @ second_place.world_T_plane
    moved = flatten(second.outline, first_T_second)
    if first.outline.distance(moved) > config.gap_m:
        return False
    return abs(first_T_second[2, 3]) <= config.gap_m


def _difference(values: gtsam.Values, first: Landmark, second: Landmark, basis: FloatArray) -> FloatArray:
    """(tangent of the normals, distance) of the first minus the second, in the second's anchor frame, shape (3,)."""
    between = values.atPose3(first.anchor_key).between(values.atPose3(second.anchor_key))
    normal_a, d_a = landmark_hesse(values.atOrientedPlane3(first.key).transform(between))
    normal_b, d_b = landmark_hesse(values.atOrientedPlane3(second.key))
    return np.append(basis.T @ (normal_a - normal_b), d_a - d_b)


def _derivative(values: gtsam.Values, key: int, first: Landmark, second: Landmark, basis: FloatArray) -> FloatArray:
    """Derivative (3, 6) or (3, 3) of the difference by the tangent of one variable."""
    is_pose = key in (first.anchor_key, second.anchor_key)
    base = values.atPose3(key) if is_pose else values.atOrientedPlane3(key)
    columns = []
    for unit in np.eye(6 if is_pose else 3):
        ends = []
        for sign in (1.0, -1.0):
            moved = gtsam.Values(values)
            moved.update(key, base.retract(sign * _STEP * unit))
            ends.append(_difference(moved, first, second, basis))
        columns.append((ends[0] - ends[1]) / (2.0 * _STEP))
    return np.column_stack(columns)


def _disjoint(pairs: Sequence[tuple[float, int, int]]) -> list[tuple[int, int]]:
    used: set[int] = set()
    chosen = []
    for _, first, second in pairs:
        if first not in used and second not in used:
            chosen.append((min(first, second), max(first, second)))
            used.update((first, second))
    return chosen
