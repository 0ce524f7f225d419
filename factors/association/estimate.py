"""What association asks of a graph and of its landmarks, and the factor of an observation by that."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol, TypeVar

import gtsam
import numpy as np

from factors.association.observations import Observation, PlaneObservation, as_observation
from spplanes import Plane
from spplanes._check import FloatArray
from spplanes.outlines.extents import Extent
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


class Placed(Protocol):
    """Where a landmark is."""

    @property
    def world_T_plane(self) -> FloatArray:
        """Its plane frame in the world, z the normal, (x, y) those of its extent, shape (4, 4)."""


AnyLandmark = TypeVar("AnyLandmark", bound=Landmark, covariant=True)


class Landmarks(Protocol[AnyLandmark]):
    """All landmarks, and where each of them is."""

    def near(
        self, normal: FloatArray, middle: FloatArray, reach: float, max_angle: float, /
    ) -> Sequence[tuple[AnyLandmark, Placed]]:
        """Landmarks of about a direction whose extent comes within `reach` (m) of a place, all in the world."""

    def placed(self, landmark_id: int, /) -> Placed:
        """Where a landmark is."""

    def __getitem__(self, landmark_id: int, /) -> AnyLandmark:
        """A landmark by its id."""


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
