"""The landmarks of the map: planes kept in the frame of the pose that first saw them, and what was seen of each."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import gtsam
from shapely.geometry.base import BaseGeometry

from factors import landmark_hesse
from slam.backend import Backend
from slam.frames import inverse, settle_frame
from slam.observations import Observation
from slam.outlines import grow
from spplanes._check import FloatArray


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
    outline: BaseGeometry
    """What was seen of it so far, in (x, y) of its plane frame."""
    sightings: list[Sighting] = field(default_factory=list)
    """Every observation that was matched to it, in time order."""
    n_points: int = 0
    """Points and beams behind it."""

    @property
    def n_keyframes(self) -> int:
        """Number of different keyframes that saw it."""
        return len({sighting.keyframe for sighting in self.sightings})


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


class LandmarkMap:
    """All landmarks, and where each of them is in the world now."""

    def __init__(self) -> None:
        self._landmarks: dict[int, Landmark] = {}
        self._next_id = 0
        self._geometry: dict[int, PlacedPlane] = {}

    def __len__(self) -> int:
        return len(self._landmarks)

    def __iter__(self) -> Iterator[Landmark]:
        return iter(self._landmarks.values())

    def __getitem__(self, landmark_id: int) -> Landmark:
        return self._landmarks[landmark_id]

    def birth(self, observation: Observation, anchor_key: int, frame: FloatArray) -> Landmark:
        """Make the landmark of an observation made at the anchor pose; `frame` is the plane frame in the body."""
        landmark = Landmark(
            id=self._next_id,
            key=gtsam.symbol("p", self._next_id),
            anchor_key=anchor_key,
            anchor_T_birth=frame,
            outline=observation.patch_in(inverse(frame)),
        )
        self._next_id += 1
        self._landmarks[landmark.id] = landmark
        return landmark

    def remove(self, landmark_id: int) -> Landmark:
        """Take a landmark out of the map."""
        self._geometry.pop(landmark_id, None)
        return self._landmarks.pop(landmark_id)

    def see(self, landmark: Landmark, observation: Observation, sighting: Sighting, plane_T_body: FloatArray) -> None:
        """Count an observation and let the outline grow by what it saw."""
        landmark.sightings.append(sighting)
        landmark.n_points += observation.n_points
        landmark.outline = grow(landmark.outline, observation.patch_in(plane_T_body))

    def refresh(self, backend: Backend) -> None:
        """Place every landmark anew by the current estimate."""
        self._geometry = {landmark.id: place(landmark, backend) for landmark in self}

    def placed(self, landmark_id: int) -> PlacedPlane:
        """Where a landmark is, as of the last refresh."""
        return self._geometry[landmark_id]

    def placements(self) -> list[tuple[Landmark, PlacedPlane]]:
        """Every landmark with its place, as of the last refresh."""
        return [(self._landmarks[key], placed) for key, placed in self._geometry.items()]


@dataclass(frozen=True, eq=False)
class PlacedPlane:
    """A landmark's plane frame in the world by the current estimate."""

    world_T_plane: FloatArray
    """Plane frame, shape (4, 4), z = normal; (x, y) are those of the landmark's outline."""

    @property
    def normal(self) -> FloatArray:
        """Unit normal in the world, shape (3,)."""
        return self.world_T_plane[:3, 2]


def place(landmark: Landmark, backend: Backend) -> PlacedPlane:
    """The landmark's plane frame in the world: the frame of its birth, moved the shortest way onto the estimate."""
    normal, d = landmark_hesse(backend.plane(landmark.key))
    return PlacedPlane(backend.pose(landmark.anchor_key) @ settle_frame(landmark.anchor_T_birth, normal, d))
