"""Map planes: landmarks as a run hands them out, in the world, with covariance and outline."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
from shapely.geometry.base import BaseGeometry

from factors import world_plane_from_joint
from slam.backend.estimator import Backend
from slam.geometry.polygons import largest_polygon
from slam.map.landmarks import Landmark, LandmarkMap
from spplanes import Plane
from spplanes._hesse import covariance_from_hesse


@dataclass(frozen=True, eq=False)
class MapPlane:
    """A landmark of the finished map, in the world."""

    id: int
    """The landmark's number."""
    plane: Plane
    """Its plane in the world; covariance from the joint marginal of anchor pose and landmark."""
    seen: BaseGeometry
    """All that was seen of it, in (x, y) of the plane's frame: polygons, and segments where only lines were seen."""
    observations: int
    """Number of keyframes that saw it."""
    kinds: tuple[str, ...]
    """Factor types that saw it, in alphabetical order."""


def map_planes(landmarks: LandmarkMap, backend: Backend, min_observations: int) -> list[MapPlane]:
    """The map: landmarks that so many keyframes saw, in order of birth."""
    return [
        map_plane(landmark, landmarks, backend) for landmark in landmarks if landmark.n_keyframes >= min_observations
    ]


def map_plane(landmark: Landmark, landmarks: LandmarkMap, backend: Backend) -> MapPlane:
    """A landmark as of the last refresh."""
    keys = [landmark.anchor_key, landmark.key]
    frame = landmarks.placed(landmark.id).world_T_plane
    plane = world_plane_from_joint(
        backend.plane(landmark.key),
        gtsam.Pose3(backend.pose(landmark.anchor_key)),
        backend.read_joint_covariance(keys).of(keys),
        centre=frame[:3, 3],
    )
    polygon = largest_polygon(landmark.outline)
    plane = Plane(frame, covariance_from_hesse(frame, plane.hesse_covariance), landmark.n_points, polygon)
    kinds = tuple(sorted({sighting.kind for sighting in landmark.sightings}))
    return MapPlane(landmark.id, plane, landmark.outline, landmark.n_keyframes, kinds)
