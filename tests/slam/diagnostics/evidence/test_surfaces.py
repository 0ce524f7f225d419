"""Planes of a map against each other: what lies behind what, and what is there twice."""

from __future__ import annotations

import numpy as np
from shapely import box

from slam.diagnostics.evidence.surfaces import Surfaces, agreement, doubled_pairs, stopped_rays
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import PlaneObservation
from slam.geometry.frames import inverse, planar_transform
from spplanes import Plane
from tests.slam.scenes import room_planes

EYE = np.eye(4)
EYE[2, 3] = 1.5


def surfaces_of(planes: list[Plane]) -> Surfaces:
    walls = tuple((plane.frame, plane.outline.buffer(-0.1)) for plane in planes if plane.outline is not None)
    return Surfaces(tuple(range(len(walls))), walls)  # type: ignore[arg-type]


def shifted(plane: Plane, along: float) -> Plane:
    frame = plane.frame.copy()
    frame[:3, 3] += along * plane.normal
    return Plane(frame, plane.covariance, plane.n_points, plane.outline)


def keyframe(pose: np.ndarray) -> Keyframe:
    return Keyframe(0, [PlaneObservation(plane.transform(inverse(pose))) for plane in room_planes()])


def test_from_its_true_pose_nothing_stops_a_ray_and_from_another_a_wall_does():
    pose, walls = planar_transform(1.0, 0.5, 0.3), surfaces_of(room_planes())
    assert not stopped_rays([keyframe(pose)], pose[None], walls, EYE)
    off = planar_transform(1.0, 1.5, 0.3)  # a metre to the left: one wall is seen a metre behind itself
    (behind,) = stopped_rays([keyframe(pose)], off[None], walls, EYE)
    assert room_planes()[behind].normal[1] < -0.9


def test_planes_agree_under_the_right_motion_only():
    first, second = planar_transform(0.0, 0.0, 0.0), planar_transform(0.8, 0.3, 0.4)
    here, there = ([plane.transform(inverse(pose)) for plane in room_planes()] for pose in (first, second))
    assert agreement(here, there, inverse(first) @ second, EYE) == (6, 0)
    confirmed, through = agreement(here, there, inverse(first) @ second @ planar_transform(-1.0, 0.5, 0.0), EYE)
    assert confirmed <= 4 and through >= 1


def test_a_surface_that_is_there_twice_is_counted_once_and_a_wall_behind_another_is_not():
    room = room_planes()
    assert doubled_pairs(surfaces_of(room)) == []
    twice = surfaces_of([*room, shifted(room[2], 0.07), shifted(room[4], 0.8), shifted(room[5], 0.005)])
    ((large, small, gap),) = doubled_pairs(twice)
    assert {large, small} == {2, 6} and abs(abs(gap) - 0.07) < 1e-9


def test_a_board_beside_a_wall_does_not_double_it():
    wall = room_planes()[4]
    beside = Plane(shifted(wall, 0.05).frame, wall.covariance, 100, box(3.8, -1.0, 6.8, 1.0))
    assert doubled_pairs(surfaces_of([wall, beside])) == []
