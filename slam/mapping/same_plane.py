"""The same-plane test: landmarks that turn out to be one plane, by chi2 on the joint state."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np
from scipy.special import chdtri

from factors import landmark_hesse
from slam.backend.estimator import Backend
from slam.geometry.frames import inverse
from slam.geometry.polygons import flatten
from slam.map.landmarks import Landmark
from slam.map.state import EstimatorState
from spplanes._check import FloatArray
from spplanes.spmodel import skew


class SamePlaneFinder:
    """Looks for landmarks that have become one plane, each pair again only when a quarter more was seen of it."""

    def __init__(self, state: EstimatorState) -> None:
        self._landmarks, self._backend, self._rules = state.landmarks, state.backend, state.config.association
        self._min_keyframes = state.config.landmarks.min_observations
        #: Sightings of both landmarks of a pair when it was last found to be two.
        self._told_apart: dict[tuple[int, int], int] = {}

    def pairs(self, touched: Iterable[int]) -> list[tuple[int, int]]:
        """Pairs (older, younger) of landmarks that are one plane by chi2 with the covariance of the whole state.

        Landmarks seen from few keyframes are left alone: what one look says may be wrong, a merge would keep it.

        Args:
            touched: ids of landmarks whose estimate or outline has just changed; only pairs with one of them are looked
                at, by the map as of its last refresh.

        Returns:
            Disjoint pairs, best first.
        """
        pairs = self._candidates(touched)
        if not pairs:
            return []
        keys = {key for pair in pairs.values() for one in pair for key in landmark_keys(one)}
        self._backend.joint_covariance(sorted(keys))  # of all at once: it is kept for the questions that follow
        limit = float(chdtri(3, self._rules.significance))
        found = [(same_plane_chi2(*pair, self._backend), *ids) for ids, pair in pairs.items()]
        self._told_apart.update({(a, b): _sightings(pairs[a, b]) for chi2, a, b in found if chi2 > limit})
        return disjoint([(a, b) for chi2, a, b in sorted(found) if chi2 <= limit])

    def _candidates(self, touched: Iterable[int]) -> dict[tuple[int, int], tuple[Landmark, Landmark]]:
        """Pairs that come near each other, along the plane and across it, by ids; not where nothing new was seen."""
        pairs: dict[tuple[int, int], tuple[Landmark, Landmark]] = {}
        gap_m, angle_rad = self._rules.gap_m, self._rules.max_angle_rad
        for first in (self._landmarks[key] for key in sorted(touched)):
            if first.n_keyframes < self._min_keyframes:
                continue
            middle, radius = self._landmarks.sphere(first.id)
            place = self._landmarks.placed(first.id)
            for second, second_place in self._landmarks.near(place.normal, middle, radius + gap_m, angle_rad):
                if second is first or second.n_keyframes < self._min_keyframes:
                    continue
                ids = min(first.id, second.id), max(first.id, second.id)
                if _sightings((first, second)) < 1.25 * self._told_apart.get(ids, 0):
                    continue
                first_T_second = inverse(place.world_T_plane) @ second_place.world_T_plane
                if abs(first_T_second[2, 3]) > gap_m:
                    continue
                pieces = (flatten(piece, first_T_second) for piece in second.extent.pieces)
                if any(first.extent.is_within(gap_m, piece) for piece in pieces):
                    pairs[ids] = (first, second)
        return pairs

    def forget(self) -> None:
        """The map has been bent: every pair is looked at again."""
        self._told_apart.clear()


def _sightings(pair: tuple[Landmark, Landmark]) -> int:
    return sum(len(one.sightings) for one in pair)


def same_plane_chi2(first: Landmark, second: Landmark, backend: Backend) -> float:
    """Squared Mahalanobis distance of two landmarks of one state, chi2 with 3 degrees of freedom if they are one.

    Their difference is taken in the frame of the second's anchor, in a basis that stays fixed: that of
    ``Unit3.basis()`` jumps where components of the normal tie.
    """
    difference, (by_first, by_pose_a, by_second, by_pose_b) = anchored_difference(
        backend.plane(first.key),
        backend.pose(first.anchor_key),
        backend.plane(second.key),
        backend.pose(second.anchor_key),
    )
    blocks: dict[int, FloatArray] = {first.key: by_first, second.key: by_second}
    for key, block in ((first.anchor_key, by_pose_a), (second.anchor_key, by_pose_b)):
        blocks[key] = blocks.get(key, np.zeros((3, block.shape[1]))) + block
    jacobian = np.hstack(list(blocks.values()))
    covariance = jacobian @ backend.joint_covariance(sorted(blocks)).of(list(blocks)) @ jacobian.T
    return float(difference @ np.linalg.solve(covariance, difference))


def landmark_keys(landmark: Landmark) -> tuple[int, int]:
    """The keys its place depends on: its own and its anchor's."""
    return landmark.key, landmark.anchor_key


def anchored_difference(
    first: gtsam.OrientedPlane3, world_T_a: FloatArray, second: gtsam.OrientedPlane3, world_T_b: FloatArray
) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
    """How two planes, each in the frame of a pose (4, 4), differ in b.

    Returns:
        (tangent of the normals, distance) of the first minus the second, shape (3,), and its derivatives by the
        tangents of the first plane (3, 3), of a (3, 6), of the second plane (3, 3) and of b (3, 6).
    """
    (normal, d), basis = landmark_hesse(second), second.normal().basis()
    moved, moved_d, (by_first, by_pose_a, by_pose_b) = _seen_from(first, inverse(world_T_b) @ world_T_a, basis.T)
    difference = np.append(basis.T @ (moved - normal), moved_d - d)
    return difference, (by_first, by_pose_a, np.diag([-1.0, -1.0, 1.0]), by_pose_b)


def _seen_from(
    plane: gtsam.OrientedPlane3, b_T_a: FloatArray, axes: FloatArray
) -> tuple[FloatArray, float, tuple[FloatArray, FloatArray, FloatArray]]:
    """A plane in the frame of a pose a as b sees it, b_T_a = (R, t): n' = R n, d' = d + t.n', however b is turned.

    Returns:
        n' (3,), d', and the derivatives of (n' along some axes (K, 3), d') by the tangents of the plane (K + 1, 3), of
        a (K + 1, 6) and of b (K + 1, 6).
    """
    rotation, shift = b_T_a[:3, :3], b_T_a[:3, 3]
    normal, d = landmark_hesse(plane)
    moved, rows = rotation @ normal, len(axes) + 1
    turned = np.vstack((axes, shift))  # of a change of n': what is asked of it, and what it does to d'
    by_plane, by_b = np.zeros((rows, 3)), np.zeros((rows, 6))
    by_plane[:, :2], by_plane[-1, 2] = turned @ rotation @ plane.normal().basis(), -1.0
    by_a = np.hstack((-turned @ rotation @ skew(normal), np.zeros((rows, 3))))
    by_a[-1, 3:] = normal
    by_b[:-1, :3], by_b[-1, 3:] = axes @ skew(moved), -moved
    return moved, float(d + shift @ moved), (by_plane, by_a, by_b)


def hesse_of(
    landmark: Landmark, backend: Backend, pose_key: int | None = None
) -> tuple[FloatArray, float, FloatArray, list[int]]:
    """A landmark in the world, or as a pose sees it.

    Returns:
        Normal (3,) and Hesse distance there, the derivative (4, K) of both and the keys it is by.
    """
    frame_T_world = np.eye(4) if pose_key is None else inverse(backend.pose(pose_key))
    anchor = frame_T_world @ backend.pose(landmark.anchor_key)
    normal, d, (by_plane, by_anchor, by_pose) = _seen_from(backend.plane(landmark.key), anchor, np.eye(3))
    blocks = {landmark.key: by_plane, landmark.anchor_key: by_anchor}
    if pose_key is not None:
        blocks[pose_key] = blocks.get(pose_key, np.zeros((4, 6))) + by_pose
    return normal, d, np.hstack(list(blocks.values())), list(blocks)


def disjoint(pairs: Sequence[tuple[int, int]]) -> list[tuple[int, int]]:
    """Those pairs whose landmarks are in no pair before them."""
    used: set[int] = set()
    chosen = []
    for pair in pairs:
        if used.isdisjoint(pair):
            chosen.append(pair)
            used.update(pair)
    return chosen
