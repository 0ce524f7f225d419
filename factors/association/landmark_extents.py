"""Landmarks of somebody's own graph: in whose frame each lives, and all that was seen of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from numbers import Integral

import gtsam
import numpy as np
from shapely.geometry.base import BaseGeometry

from factors._check import as_key, plane_in, pose_in, told_key
from factors.association.estimate import settled
from factors.association.observations import Observation, as_observation
from factors.landmarks import plane_landmark
from spplanes import Plane
from spplanes._check import FloatArray, read_only
from spplanes.outlines.extents import Extent
from spplanes.spmodel import inverse_transform


@dataclass(frozen=True, eq=False)
class LandmarkExtent:
    """A plane landmark as the graph does not know it. It grows, and moves to another anchor, by `LandmarkExtents`."""

    key: int
    """Its GTSAM key."""
    anchor_key: int | None
    """Key of the pose in whose frame it lives; None: in the world."""
    anchor_T_plane: FloatArray
    """Its plane frame when it was started or moved, in the frame it lives in, (4, 4); it follows the estimate."""
    extent: Extent
    """What was seen of it, in (x, y) of its plane frame."""
    pose_keys: set[int] = field(default_factory=set)
    """The poses that saw it."""

    @property
    def id(self) -> int:
        """Its key."""
        return self.key

    @property
    def n_keyframes(self) -> int:
        """From how many poses it was seen."""
        return len(self.pose_keys)

    @property
    def outline(self) -> BaseGeometry:
        """What was seen of it, in (x, y) of its plane frame, m."""
        return self.extent.geometry


class LandmarkExtents:
    """Landmarks by key, growing as observations are added. Estimates stay in the graph and are asked of values."""

    def __init__(self) -> None:
        self._landmarks: dict[int, LandmarkExtent] = {}

    def __len__(self) -> int:
        return len(self._landmarks)

    def __iter__(self) -> Iterator[LandmarkExtent]:
        """In the order of their keys."""
        return iter([self._landmarks[key] for key in sorted(self._landmarks)])

    def __contains__(self, plane_key: object) -> bool:
        return isinstance(plane_key, Integral) and plane_key in self._landmarks

    def __getitem__(self, plane_key: int, /) -> LandmarkExtent:
        """ValueError: no landmark of that key."""
        if plane_key not in self:
            raise ValueError(f"plane_key: expected a landmark that was started, got {_told(plane_key)}")
        return self._landmarks[plane_key]

    def start(
        self,
        plane_key: int,
        observation: Observation | Plane,
        pose_key: int,
        values: gtsam.Values,
        *,
        anchor_key: int | None = None,
    ) -> gtsam.OrientedPlane3:
        """Start a landmark with what one pose saw of it; its initial value, in the frame of the anchor or the world.

        Args:
            plane_key: a new key.
            observation: in the frame of the pose.
            pose_key: the pose that saw it.
            values: hold the pose and the anchor.
            anchor_key: the pose in whose frame the landmark is to live; None: the world.

        Raises:
            ValueError: a landmark of that key, or a variable that is no plane, is there; no such pose in values; no
                observation.
        """
        key, seen = as_key("plane_key", plane_key), as_observation("observation", observation)
        if key in self._landmarks:
            raise ValueError(f"plane_key: expected a new landmark's, got {told_key(key)}, which is there")
        body_T_plane = seen.full_plane(1.0)
        anchor_T_world = inverse_transform(_frame_of("anchor_key", anchor_key, values))
        anchor_T_body = anchor_T_world @ _frame_of("pose_key", pose_key, values)
        if values.exists(key):
            plane_in("plane_key", values, key)
        extent = Extent(seen.patch_in(inverse_transform(body_T_plane.frame)))
        return self._put(key, anchor_key, anchor_T_body @ body_T_plane.frame, extent, {pose_key})

    def see(self, plane_key: int, observation: Observation | Plane, pose_key: int, values: gtsam.Values) -> None:
        """Let a landmark's extent grow by what a pose saw of it, where `values` has pose, landmark and anchor.

        ValueError: no landmark of that key, one of them not in values, no observation.
        """
        seen, landmark = as_observation("observation", observation), self[plane_key]
        world_T_body = _frame_of("pose_key", pose_key, values)
        plane_T_body = inverse_transform(place_all([landmark], values)[0]) @ world_T_body
        landmark.extent.grow(seen.patch_in(plane_T_body))
        landmark.pose_keys.add(pose_key)

    def change_anchor(self, plane_key: int, anchor_key: int | None, values: gtsam.Values) -> gtsam.OrientedPlane3:
        """Let a landmark live in the frame of another pose, or the world; its value there, as `factors.change_anchor`.

        `values` has the landmark and both anchors. ValueError: no landmark of that key, one of them not in values.
        """
        landmark = self[plane_key]
        frame = inverse_transform(_frame_of("anchor_key", anchor_key, values)) @ place_all([landmark], values)[0]
        return self._put(landmark.key, anchor_key, frame, landmark.extent, landmark.pose_keys)

    def _put(
        self, key: int, anchor_key: int | None, frame: FloatArray, extent: Extent, pose_keys: set[int]
    ) -> gtsam.OrientedPlane3:
        """Have a landmark; its value in the frame it lives in."""
        self._landmarks[key] = LandmarkExtent(key, anchor_key, read_only(frame), extent, pose_keys)
        return plane_landmark(Plane(frame, np.eye(3)))

    def remove(self, plane_key: int) -> LandmarkExtent:
        """Take a landmark out, one that was found to be another, say. ValueError: no landmark of that key."""
        landmark = self[plane_key]
        del self._landmarks[plane_key]
        return landmark


def place_all(landmarks: list[LandmarkExtent], values: gtsam.Values) -> FloatArray:
    """Plane frames of landmarks in the world by an estimate, shape (N, 4, 4)."""
    anchors = {key: _frame_of("landmarks", key, values) for key in {landmark.anchor_key for landmark in landmarks}}
    return settled(
        [landmark.anchor_T_plane for landmark in landmarks],
        [anchors[landmark.anchor_key] for landmark in landmarks],
        [plane_in("landmarks", values, landmark.key) for landmark in landmarks],
    )


def _frame_of(name: str, key: int | None, values: gtsam.Values) -> FloatArray:
    """world_T_body of a pose in values; of None, the world."""
    return np.eye(4) if key is None else pose_in(name, values, key).matrix()


def _told(key: object) -> str:
    return told_key(key) if isinstance(key, int) and not isinstance(key, bool) and 0 <= key < 2**64 else repr(key)
