"""The landmarks of the map: planes kept in the frame of an anchor pose, and what was seen of each."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterator
from dataclasses import dataclass, field

import gtsam
import numpy as np
from shapely.geometry.base import BaseGeometry

from factors.association.estimate import PlacedLandmarks, settled
from factors.association.observations import Observation
from slam.backend.estimator import Backend
from spplanes._check import FloatArray
from spplanes.outlines.extents import Extent


@dataclass(eq=False)
class Landmark:
    """A plane of the map. Its estimate lives in the graph; here is what the graph does not know."""

    id: int
    """Number in order of birth; never used twice."""
    key: int
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
            self.sightings = [sighting for sighting in self.sightings if sighting.keyframe != keyframe]
            insort(self.seen_by_past, keyframe)
        return gone

    def _frames(self) -> list[int]:
        """The keyframes that saw it, ascending; what sightings have been added since is counted in."""
        counted, number = self._counted
        if counted is not self.sightings or number > len(self.sightings):
            self._seen_from, number = sorted({one.keyframe for one in self.sightings}), len(self.sightings)
        for keyframe in (one.keyframe for one in self.sightings[number:]):
            if not _is_any_between(self._seen_from, keyframe, keyframe):
                insort(self._seen_from, keyframe)
        self._counted = (self.sightings, len(self.sightings))
        return self._seen_from


def _is_any_between(ascending: list[int], first: int, last: int) -> bool:
    place = bisect_left(ascending, first)
    return place < len(ascending) and ascending[place] <= last


@dataclass(frozen=True)
class Sighting:
    """One observation of a landmark, by its index in its keyframe, and its factor in iSAM2."""

    keyframe: int
    observation: int
    factor_index: int
    kind: str
    robust: str | None = None
    """Robust kernel on it where it is matched: of a place that the planes had to find some of it is wrong."""
    sensor: str | None = None
    """The sensor whose errors of calibration it has; None: it has none that are known."""


class LandmarkMap(PlacedLandmarks[Landmark]):
    """All landmarks, and where each of them is in the world, as of the last refresh."""

    def __init__(self) -> None:
        super().__init__({}, np.empty((0, 4, 4)))
        self._next_id = 0

    def __len__(self) -> int:
        return len(self._landmarks)

    def __iter__(self) -> Iterator[Landmark]:
        return iter(self._landmarks.values())

    def __contains__(self, landmark_id: object) -> bool:
        return landmark_id in self._landmarks

    def birth(self, observation: Observation, anchor_key: int, frame: FloatArray, plane_T_body: FloatArray) -> Landmark:
        """Make the landmark of an observation; `frame` is its plane frame in the anchor pose's frame."""
        number, patch = self._next_id, observation.patch_in(plane_T_body)
        landmark = Landmark(number, gtsam.symbol("p", number), anchor_key, frame, patch)
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
        poses = {key: backend.pose(key) for key in {landmark.anchor_key for landmark in self}}
        frames, anchors = [one.anchor_T_birth for one in self], [poses[one.anchor_key] for one in self]
        self._place(settled(frames, anchors, [backend.plane(one.key) for one in self]))
