"""The landmarks of the map: planes kept in the frame of an anchor pose, and what was seen of each."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np
from shapely.geometry.base import BaseGeometry

from factors import landmark_hesse
from factors.association.observations import Observation
from slam.backend.estimator import Backend
from spplanes._check import FloatArray
from spplanes.outlines.extents import Extent, settle_frames


@dataclass(eq=False)
class Landmark:
    """A plane of the map. Its estimate lives in the graph; here is what the graph does not know."""

    id: int
    """Number in order of birth; never used twice."""
    key: int
    """Its GTSAM key."""
    anchor_key: int
    """Key of the pose in whose frame it lives."""
    anchor_T_birth: FloatArray
    """Plane frame at birth, in the anchor's frame: (x, y) of the outline, shape (4, 4)."""
    first_outline: BaseGeometry
    """What was seen of it at birth, in (x, y) of its plane frame."""
    sightings: list[Sighting] = field(default_factory=list)
    """Every observation that was matched to it, in time order."""
    n_points: int = 0
    """Points and beams behind it."""
    known: int = 0
    """Keyframes that saw it on earlier missions: it comes from a prior map."""
    seen_by_past: list[int] = field(default_factory=list)
    """Keyframes that saw it and have left the graph, ascending: their sightings are gone."""

    def __post_init__(self) -> None:
        self.extent = Extent(self.first_outline)
        self._seen_from: list[int] = []
        self._counted: tuple[list[Sighting], int] = (self.sightings, 0)

    @property
    def outline(self) -> BaseGeometry:
        """What was seen of it so far, in (x, y) of its plane frame."""
        return self.extent.geometry

    @property
    def first_keyframe(self) -> int:
        """The keyframe of its birth; -1 when it comes from a prior map and has not been seen since."""
        return self.sightings[0].keyframe if self.sightings else -1

    @property
    def n_keyframes(self) -> int:
        """Number of different keyframes that saw it."""
        return self.known + len(self._frames()) + len(self.seen_by_past)

    def was_seen_between(self, first: int, last: int) -> bool:
        """Whether a keyframe from the first to the last, both included, saw it."""
        return _is_any_between(self._frames(), first, last) or _is_any_between(self.seen_by_past, first, last)

    def let_go(self, keyframe: int) -> list[int]:
        """Forget what a keyframe saw of it, except that it did; indices of the factors of that."""
        gone = [sighting.factor_index for sighting in self.sightings if sighting.keyframe == keyframe]
        if gone:
            frames = self._frames()
            frames.remove(keyframe)
            self.sightings = [sighting for sighting in self.sightings if sighting.keyframe != keyframe]
            self._counted = (self.sightings, len(self.sightings))
            insort(self.seen_by_past, keyframe)
        return gone

    def _frames(self) -> list[int]:
        """The keyframes that saw it, ascending; what sightings have been added since is counted in."""
        if self._counted[0] is not self.sightings or self._counted[1] > len(self.sightings):
            self._counted, self._seen_from = (self.sightings, 0), []
        for sighting in self.sightings[self._counted[1] :]:
            place = bisect_left(self._seen_from, sighting.keyframe)
            if place == len(self._seen_from) or self._seen_from[place] != sighting.keyframe:
                self._seen_from.insert(place, sighting.keyframe)
        self._counted = (self.sightings, len(self.sightings))
        return self._seen_from


def _is_any_between(ascending: list[int], first: int, last: int) -> bool:
    place = bisect_left(ascending, first)
    return place < len(ascending) and ascending[place] <= last


@dataclass(frozen=True)
class Sighting:
    """One observation of a landmark."""

    keyframe: int
    """Index of the keyframe."""
    observation: int
    """Index of the observation in the keyframe."""
    factor_index: int
    """Index of its factor in iSAM2."""
    kind: str
    """Factor type."""
    robust: str | None = None
    """Robust kernel on it where it is matched: of a place that the planes had to find some of it is wrong."""


class LandmarkMap:
    """All landmarks, and where each of them is in the world now."""

    def __init__(self) -> None:
        self._landmarks: dict[int, Landmark] = {}
        self._next_id = 0
        self._ids: list[int] = []
        self._rows: dict[int, int] = {}
        self._world_T_plane = np.empty((0, 4, 4))
        self._middles = np.empty((0, 3))
        self._radii = np.empty(0)

    def __len__(self) -> int:
        return len(self._landmarks)

    def __iter__(self) -> Iterator[Landmark]:
        return iter(self._landmarks.values())

    def __contains__(self, landmark_id: object) -> bool:
        return landmark_id in self._landmarks

    def __getitem__(self, landmark_id: int) -> Landmark:
        return self._landmarks[landmark_id]

    def birth(self, observation: Observation, anchor_key: int, frame: FloatArray, plane_T_body: FloatArray) -> Landmark:
        """Make the landmark of an observation; `frame` is its plane frame in the anchor pose's frame."""
        landmark = Landmark(
            id=self._next_id,
            key=gtsam.symbol("p", self._next_id),
            anchor_key=anchor_key,
            anchor_T_birth=frame,
            first_outline=observation.patch_in(plane_T_body),
        )
        self._next_id += 1
        self._landmarks[landmark.id] = landmark
        return landmark

    def plant(self, landmark: Landmark) -> None:
        """Take in a landmark of a prior map, or one that is back; those born later have larger numbers."""
        self._landmarks[landmark.id] = landmark
        self._landmarks = dict(sorted(self._landmarks.items()))
        self._next_id = max(self._next_id, landmark.id + 1)

    def remove(self, landmark_id: int) -> Landmark:
        """Take a landmark out of the map."""
        self._rows.pop(landmark_id, None)
        return self._landmarks.pop(landmark_id)

    def see(self, landmark: Landmark, observation: Observation, sighting: Sighting, plane_T_body: FloatArray) -> None:
        """Count an observation and let the outline grow by what it saw."""
        landmark.sightings.append(sighting)
        landmark.n_points += observation.n_points
        landmark.extent.grow(observation.patch_in(plane_T_body))

    def let_go(self, keyframe: int) -> list[int]:
        """Forget what a keyframe saw, which is about to leave the graph; indices of its factors."""
        seen = [landmark for landmark in self if landmark.was_seen_between(keyframe, keyframe)]
        return [index for landmark in seen for index in landmark.let_go(keyframe)]

    def refresh(self, backend: Backend) -> None:
        """Place every landmark anew by the current estimate."""
        self._ids = list(self._landmarks)
        self._rows = {landmark_id: row for row, landmark_id in enumerate(self._ids)}
        if not self._rows:
            self._middles, self._radii = np.empty((0, 3)), np.empty(0)
            return
        anchors = {landmark.anchor_key for landmark in self}
        poses = {key: backend.pose(key) for key in anchors}
        births = np.array([landmark.anchor_T_birth for landmark in self])
        hesse = [landmark_hesse(backend.plane(landmark.key)) for landmark in self]
        settled = settle_frames(births, np.array([normal for normal, _ in hesse]), np.array([d for _, d in hesse]))
        self._world_T_plane = np.array([poses[landmark.anchor_key] for landmark in self]) @ settled
        low, high = np.split(np.array([landmark.extent.bounds for landmark in self]), 2, axis=1)
        middles = 0.5 * (low + high)
        rotations, origins = self._world_T_plane[:, :3, :3], self._world_T_plane[:, :3, 3]
        self._middles = np.einsum("nij,nj->ni", rotations[:, :, :2], middles) + origins
        self._radii = 0.5 * np.linalg.norm(high - low, axis=1)

    def placed(self, landmark_id: int) -> PlacedPlane:
        """Where a landmark is, as of the last refresh."""
        return PlacedPlane(self._world_T_plane[self._rows[landmark_id]])

    def near(
        self, normal: FloatArray, middle: FloatArray, reach: float, max_angle: float
    ) -> list[tuple[Landmark, PlacedPlane]]:
        """Landmarks of about a direction that come within `reach` of a place, as of the last refresh.

        Args:
            normal: unit normal in the world, shape (3,).
            middle: the place in the world, shape (3,).
            reach: distance from there to the sphere around what was seen of the landmark, m.
            max_angle: largest angle between the normals, rad.
        """
        close = np.flatnonzero(np.linalg.norm(self._middles - middle, axis=1) <= self._radii + reach)
        facing = close[self._world_T_plane[close, :3, 2] @ normal >= np.cos(min(max_angle, np.pi))]
        ids = (self._ids[row] for row in facing.tolist())
        return [(self._landmarks[key], self.placed(key)) for key in ids if key in self._rows]

    def sphere(self, landmark_id: int) -> tuple[FloatArray, float]:
        """Middle (3,) in the world and radius of what was seen of a landmark, as of the last refresh."""
        row = self._rows[landmark_id]
        return self._middles[row], float(self._radii[row])


@dataclass(frozen=True, eq=False)
class PlacedPlane:
    """A landmark's plane frame in the world by the current estimate."""

    world_T_plane: FloatArray
    """Plane frame, shape (4, 4), z = normal; (x, y) are those of the landmark's outline."""

    @property
    def normal(self) -> FloatArray:
        """Unit normal in the world, shape (3,)."""
        return self.world_T_plane[:3, 2]
