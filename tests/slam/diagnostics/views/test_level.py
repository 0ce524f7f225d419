"""Views of level lasers agree where poses are right, and see through each other where they are not."""

import numpy as np
import pytest

from slam.diagnostics.evidence.mounts import mount_evidence
from slam.diagnostics.evidence.surfaces import free_space_evidence
from slam.diagnostics.views import View, compare, pairs_of, views_of
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.geometry.frames import inverse, planar_transform
from slam.sensors.rig import Rig, Sensor
from spplanes._check import FloatArray
from tests.slam.laser_floors import FloorPlan, cast

#: A room of 8 x 5 m with a box in it, free space on the left of each wall.
PLAN = FloorPlan()
PLAN.add_chain([(0.0, 0.0), (8.0, 0.0), (8.0, 5.0), (0.0, 5.0), (0.0, 0.0)])
PLAN.add_box(5.0, 3.5, 1.0, 1.0)
WALLS = np.array(PLAN.walls)
ANGLES = np.deg2rad(np.arange(-90.0, 91.0))
RIG = Rig(sensors={"laser": Sensor(kind="line", range_sigma_m=0.01, range_max_m=20.0)})


def beams(pose: FloatArray, rng: np.random.Generator, mount: FloatArray | None = None) -> FloatArray:
    """Returns of a laser at a pose (x, y, theta), 1 cm of noise, as rows (x0, y0, x1, y1) in the body."""
    ranges = cast(WALLS, np.zeros((len(WALLS), 32)), pose, ANGLES) + rng.normal(0.0, 0.01, ANGLES.size)
    ends = np.column_stack((ranges * np.cos(ANGLES), ranges * np.sin(ANGLES)))
    ends = ends if mount is None else ends @ mount.T
    return np.hstack((np.zeros_like(ends), ends))


def way(count: int) -> FloatArray:
    """Poses (x, y, theta) of a curve through the room."""
    s = np.linspace(0.0, 1.0, count)
    return np.column_stack((1.5 + 3.0 * s, 1.2 + 1.5 * s**2, 0.8 * s))


def keyframes(poses: FloatArray, mount: FloatArray | None = None, seed: int = 0) -> list[Keyframe]:
    rng, frames = np.random.default_rng(seed), []
    for k, pose in enumerate(poses):
        step = inverse(planar_transform(*poses[k - 1])) @ planar_transform(*pose)
        motion = Motion(step, 1e-4 * np.eye(3), (1e-3, 1e-3, 1e-3)) if k else None
        frames.append(Keyframe(k, [], motion, returns=beams(pose, rng, mount)))
    return frames


def test_a_view_confirms_what_it_saw_and_says_nothing_of_what_is_hidden():
    here = View.of(beams(np.array([1.5, 2.5, 0.0]), np.random.default_rng(1)))
    at_wall, in_front, behind = np.array([[6.5, 0.0]]), np.array([[3.0, 0.0]]), np.array([[7.5, 0.0]])
    assert here.confirms(at_wall).all() and not here.sees_through(at_wall).any()
    assert here.sees_through(in_front).all() and not here.confirms(in_front).any()
    assert not here.sees_through(behind).any() and not here.confirms(behind).any()


def test_two_views_agree_at_their_true_poses_and_not_half_a_metre_off():
    rng, first, second = np.random.default_rng(2), np.array([1.5, 1.5, 0.2]), np.array([3.0, 2.5, 0.9])
    here, there = View.of(beams(first, rng)), View.of(beams(second, rng))
    here_T_there = inverse(planar_transform(*first)) @ planar_transform(*second)
    confirmed, through = compare(here, there, here_T_there)
    assert confirmed > 10 and through == 0
    assert compare(here, there, here_T_there @ planar_transform(-0.4, 0.3, 0.0))[1] > 3


def test_right_poses_are_no_evidence_and_a_jump_in_them_is():
    poses = way(24)
    views, truth = views_of(keyframes(poses)), np.array([planar_transform(*pose) for pose in poses])
    assert list(free_space_evidence(views, truth)) == []
    bent = truth.copy()
    bent[12:] = planar_transform(-0.3, 0.25, 0.0) @ bent[12:]
    (found,) = free_space_evidence(views, bent)
    assert found.p_value < 1e-4 and found.size > 0.2
    assert min(found.keyframes) < 12 <= max(found.keyframes) and "go through surfaces" in found.sentence


def test_every_keyframe_is_compared_with_other_stretches_of_the_way():
    pairs = pairs_of(range(20), np.array([planar_transform(0.5 * k, 0.0, 0.0) for k in range(10)] * 2))
    assert all(one != other for one, other in pairs) and (0, 10) in pairs  # the same place, a lap later


@pytest.mark.parametrize(
    ("mount", "name"), [(-np.eye(2), "backwards"), (np.diag([1.0, -1.0]), "upside down (roll")], ids=["yaw", "roll"]
)
def test_a_laser_mounted_otherwise_than_stated_is_found_and_named(mount: FloatArray, name: str):
    (found,) = mount_evidence(keyframes(way(24), mount=mount), RIG)
    assert found.grade == "broken" and found.p_value < 1e-4
    assert name in found.sentence and "keyframes 0 to 23" in found.sentence


def test_a_mount_as_stated_is_never_taken_for_another():
    for seed in range(5):
        assert list(mount_evidence(keyframes(way(24), seed=seed), RIG)) == []


def test_who_walks_away_is_no_surface_that_was_seen_through_and_a_room_all_round_is_one():
    angles = np.linspace(-np.pi, np.pi, 721)[:-1]
    room = 2.5 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))

    def seen(ranges: FloatArray) -> View:
        ends = ranges[:, None] * np.stack((np.cos(angles), np.sin(angles)), axis=1)
        return View.of(np.hstack((np.zeros_like(ends), ends)))

    empty, with_somebody = seen(room), seen(np.where(np.abs(angles - 0.7) < 0.12, 1.4, room))
    confirmed, through = compare(empty, with_somebody, np.eye(4))
    assert through == 0 and confirmed > 30
    wall = np.where(np.abs(angles - 0.7) < 0.5, 1.4, room)  # wider than anybody is
    assert compare(empty, seen(wall), np.eye(4))[1] >= 2
