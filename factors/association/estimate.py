"""What association asks of a graph and of its landmarks, and the factor of an observation by that."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import gtsam
import numpy as np

from factors._conventions import landmark_hesse
from factors.association.observations import Observation, PlaneObservation, as_observation
from spplanes import Plane
from spplanes._check import FloatArray
from spplanes.outlines.extents import Extent, settle_frames
from spplanes.spmodel import inverse_transform


class KeyedCovariance:
    """A joint marginal covariance of a few variables, each in its tangent at the estimate, addressed by key."""

    def __init__(self, keys: Sequence[int], full: FloatArray, sizes: Sequence[int]) -> None:
        ends = np.cumsum(sizes).tolist()
        self._columns = {key: np.arange(end - size, end) for key, size, end in zip(keys, sizes, ends, strict=True)}
        self.full = full
        """The whole matrix, in the order of the keys, shape (D, D)."""

    def columns(self, keys: Sequence[int], /) -> np.ndarray:
        """Rows and columns of the stacked tangents of some of its variables."""
        return np.concatenate([self._columns[key] for key in keys])

    def of(self, keys: Sequence[int]) -> FloatArray:
        """Covariance of the stacked tangents of some of its variables, in that order."""
        columns = self.columns(keys)
        return self.full[np.ix_(columns, columns)]


class Estimate(Protocol):
    """A solution of a graph with its covariances."""

    def pose(self, key: int, /) -> FloatArray:
        """world_T_body of a pose, shape (4, 4)."""

    def plane(self, key: int, /) -> gtsam.OrientedPlane3:
        """A plane landmark, in its anchor's frame."""

    def values_of(self, keys: Sequence[int], /) -> gtsam.Values:
        """The estimates of some variables, and maybe of more."""

    def covariance(self, key: int, /) -> FloatArray:
        """Marginal covariance of a variable, in GTSAM's tangent."""

    def joint_covariance(self, keys: Sequence[int], /) -> KeyedCovariance:
        """Joint marginal covariance of some variables, and maybe of more."""


class Landmark(Protocol):
    """A plane of the map, as far as association looks at it."""

    @property
    def id(self) -> int:
        """Its name; equals are taken in its order."""

    @property
    def key(self) -> int:
        """Its GTSAM key."""

    @property
    def anchor_key(self) -> int | None:
        """Key of the pose in whose frame it lives; None: in the world."""

    @property
    def extent(self) -> Extent:
        """What was seen of it, in (x, y) of its plane frame."""

    @property
    def n_keyframes(self) -> int:
        """From how many poses it was seen."""


@dataclass(frozen=True, eq=False)
class PlacedPlane:
    """A landmark's plane frame in the world."""

    world_T_plane: FloatArray
    """Plane frame, shape (4, 4), z = normal; (x, y) are those of the landmark's extent."""

    @property
    def normal(self) -> FloatArray:
        """Unit normal in the world, shape (3,)."""
        return self.world_T_plane[:3, 2]


AnyLandmark = TypeVar("AnyLandmark", bound=Landmark, covariant=True)


class PlacedLandmarks(Generic[AnyLandmark]):
    """Landmarks by id, and where each of them was when they were placed last."""

    def __init__(self, landmarks: dict[int, AnyLandmark], world_T_plane: FloatArray) -> None:
        self._landmarks = landmarks
        self._place(world_T_plane)

    def __getitem__(self, landmark_id: int, /) -> AnyLandmark:
        return self._landmarks[landmark_id]

    def _place(self, world_T_plane: FloatArray) -> None:
        """Plane frames of all landmarks, in their order, shape (N, 4, 4)."""
        self._world_T_plane, self._ids = world_T_plane, list(self._landmarks)
        self._rows = {landmark_id: row for row, landmark_id in enumerate(self._ids)}
        bounds = np.array([landmark.extent.bounds for landmark in self._landmarks.values()]).reshape(-1, 4)
        low, high = bounds[:, :2], bounds[:, 2:]
        rotations, origins = world_T_plane[:, :3, :2], world_T_plane[:, :3, 3]
        self._middles = np.einsum("nij,nj->ni", rotations, 0.5 * (low + high)) + origins
        self._radii = 0.5 * np.linalg.norm(high - low, axis=1)

    def placed(self, landmark_id: int, /) -> PlacedPlane:
        """Where a landmark is."""
        return PlacedPlane(self._world_T_plane[self._rows[landmark_id]])

    def near(
        self, normal: FloatArray, middle: FloatArray, reach: float, max_angle: float, /
    ) -> list[tuple[AnyLandmark, PlacedPlane]]:
        """Landmarks about a place, in their order.

        Their normals are within `max_angle` (rad) of one in the world (3,), and the spheres around what was seen of
        them come within `reach` (m) of a point in the world (3,).
        """
        close = np.flatnonzero(np.linalg.norm(self._middles - middle, axis=1) <= self._radii + reach)
        facing = close[self._world_T_plane[close, :3, 2] @ normal >= np.cos(min(max_angle, np.pi))]
        ids = (self._ids[row] for row in facing.tolist())
        return [(self._landmarks[one], self.placed(one)) for one in ids if one in self._rows]

    def sphere(self, landmark_id: int, /) -> tuple[FloatArray, float]:
        """Middle (3,) in the world and radius of what was seen of a landmark."""
        row = self._rows[landmark_id]
        return self._middles[row], float(self._radii[row])


def settled(
    frames: Sequence[FloatArray], world_T_anchor: Sequence[FloatArray], planes: Sequence[gtsam.OrientedPlane3]
) -> FloatArray:
    """Plane frames in the world, (N, 4, 4), of frames in their anchors' that follow what is known of the planes."""
    hesse = [landmark_hesse(plane) for plane in planes]
    normals, distances = np.array([normal for normal, _ in hesse]), np.array([d for _, d in hesse])
    followed = settle_frames(np.reshape(frames, (-1, 4, 4)), normals.reshape(-1, 3), distances)
    return np.reshape(world_T_anchor, (-1, 4, 4)) @ followed


def observation_factor(
    observation: Observation | Plane,
    pose_key: int,
    landmark: Landmark,
    estimate: Estimate,
    robust: str | None = None,
) -> Any:
    """The factor of an observation of a landmark from a pose, both in the graph. ValueError: no observation."""
    seen, expected = as_observation("observation", observation), None
    asks = not isinstance(seen, PlaneObservation)  # its factor does not depend on where the plane is expected
    if asks and landmark.anchor_key is not None and landmark.anchor_key != pose_key:
        anchor_T_body = inverse_transform(estimate.pose(landmark.anchor_key)) @ estimate.pose(pose_key)
        expected = estimate.plane(landmark.key).transform(gtsam.Pose3(anchor_T_body))
    return seen.factor(pose_key, landmark.key, landmark.anchor_key, robust, expected)
