"""Loop closure: the local map about a keyframe, its landmarks as walls and what level lasers saw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.backend.estimator import Backend, JointCovariance, pose_symbol
from slam.config import LoopConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.occupancy import Raster
from slam.geometry.frames import inverse, lift
from slam.loop_closure.candidates import DrivenPath
from slam.map.landmarks import Landmark, LandmarkMap
from slam.mapping.same_plane import hesse_from, landmark_keys
from slam.registration.place_recognition import Wall
from slam.registration.submaps import view_of
from spplanes._check import FloatArray

#: Walls that lean more than this from the body's vertical take no part: sine of the lean.
_MAX_LEAN = 0.2


def surroundings(
    index: int, path: DrivenPath, landmarks: LandmarkMap, config: LoopConfig, min_keyframes: int
) -> list[Landmark]:
    """Confirmed landmarks seen within the window of travel around a keyframe."""
    first, last = path.window(index, config.window_m)
    return [
        landmark
        for landmark in landmarks
        if landmark.n_keyframes >= min_keyframes and landmark.was_seen_between(first, last)
    ]


def view_about(
    frame: int, path: DrivenPath, keyframes: Sequence[Keyframe], backend: Backend, config: LoopConfig
) -> Raster | None:
    """What level lasers saw within the window of travel around a keyframe, in its frame."""
    first, last = path.window(frame, config.window_m)
    members = list(range(first, last + 1))
    poses = [backend.pose(pose_symbol(one)) for one in members]
    return view_of([keyframes[one] for one in members], poses, path.pose(frame), config)


def walls_from(pose_key: int, seen: Sequence[Landmark], landmarks: LandmarkMap, backend: Backend) -> list[Wall]:
    """The landmarks as walls in the frame of a pose, with their covariance relative to it."""
    keys = {pose_key}.union(*(landmark_keys(landmark) for landmark in seen))
    joint = backend.joint_covariance(sorted(keys))
    body_T_world = inverse(backend.pose(pose_key))
    return [_wall_from(pose_key, one, body_T_world, landmarks, backend, joint) for one in seen]


def _wall_from(
    pose_key: int,
    landmark: Landmark,
    body_T_world: FloatArray,
    landmarks: LandmarkMap,
    backend: Backend,
    joint: JointCovariance,
) -> Wall:
    normal, d, jacobian, keys = hesse_from(landmark, pose_key, backend)
    covariance = jacobian @ joint.of(keys) @ jacobian.T
    level = max(float(np.hypot(normal[0], normal[1])), 1.0 - _MAX_LEAN)
    by_hesse = np.zeros((2, 4))  # of (alpha, rho): the wall's normal points into it, the landmark's out of it
    by_hesse[0, :2] = np.array((-normal[1], normal[0])) / level**2
    by_hesse[1, 3] = -1.0 / level
    body_T_plane = body_T_world @ landmarks.placed(landmark.id).world_T_plane
    corners = lift(landmark.extent.corners, body_T_plane)[:, :2]
    alpha = float(np.arctan2(-normal[1], -normal[0]))
    along = corners @ np.array((-np.sin(alpha), np.cos(alpha)))
    ends = corners[[int(np.argmin(along)), int(np.argmax(along))]]
    return Wall(alpha, -d / level, by_hesse @ covariance @ by_hesse.T, ends)
