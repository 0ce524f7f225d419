"""Views of level lasers and of 3D sensors agree where poses are right, and see through each other where they are not.

Walls are looked for; what may walk is no wall.
"""

import numpy as np
import pytest

from slam.diagnostics.evidence.mounts import mount_evidence
from slam.diagnostics.evidence.surfaces import free_space_evidence
from slam.diagnostics.views import ScanView, View, compare, held_against, pairs_of, views_of
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.frontend.scan_surfaces import ON_EDGE, ON_NO_PLANE, ON_PLANE
from slam.geometry.frames import inverse, planar_transform
from slam.registration.visibility import Scan
from slam.sensors.rig import Rig, Sensor
from spplanes._check import FloatArray
from tests.slam.depth_scenes import with_widths
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


def test_a_place_beside_the_corner_of_something_is_confirmed_and_not_seen_through():
    """Beams pass close by it: to the tolerance it is the corner."""
    angles = np.deg2rad(np.arange(-20.0, 20.5, 0.5))
    ends = np.where(angles < 0.0, 2.0, 6.0)[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))
    here, beside = View.of(np.hstack((np.zeros_like(ends), ends))), np.array([[2.0, 0.05]])
    assert here.confirms(beside).all() and here.sees_through(beside).all()
    assert held_against(here, beside) == (1, 0)


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


UP = np.array([0.0, 0.0, 1.0])


def facing(
    ahead_m: float, half_m: float, kind: int = ON_PLANE, normal: tuple[float, float, float] = (-1.0, 0.0, 0.0)
) -> FloatArray:
    """Elements of a square board so far ahead, so wide to either side, one every 10 cm."""
    steps = np.arange(-half_m, half_m + 0.05, 0.1)
    y, z = (axis.ravel() for axis in np.meshgrid(steps, steps))
    return np.column_stack((np.full(y.size, ahead_m), y, z, np.tile([*normal, 0.01, kind], (y.size, 1))))


def view(*parts: FloatArray) -> ScanView:
    return ScanView(Scan(with_widths(np.concatenate(parts)), np.zeros(3)), UP)


def moved(x: float) -> FloatArray:
    return planar_transform(x, 0.0, 0.0)


def test_a_wall_is_confirmed_where_it_is_seen_through_where_it_is_not_and_hidden_behind_itself():
    wall = view(facing(4.0, 2.0))
    count = len(wall.looks)
    assert count > 40 and compare(wall, wall, moved(0.0)) == compare(wall, wall, moved(-0.05)) == (count, 0)
    confirmed, through = compare(wall, wall, moved(-1.0))  # what is nearer than the wall reaches out of view
    assert confirmed == 0 and through > count / 2 and compare(wall, wall, moved(1.0)) == (0, 0)


def test_edges_floors_and_what_may_walk_are_no_walls():
    wall, board = facing(4.0, 2.0), facing(2.0, 0.3, ON_NO_PLANE)
    alone = view(wall)
    np.testing.assert_array_equal(view(wall, board).looks, alone.looks)  # 0.85 m from corner to corner
    assert len(view(wall, facing(2.0, 0.6)).looks) > len(alone.looks)
    assert len(view(facing(4.0, 2.0, ON_EDGE)).looks) == 0
    assert len(view(facing(4.0, 2.0, normal=(0.0, 0.0, 1.0))).looks) == 0


def test_who_has_gone_is_not_seen_through_and_a_wall_that_is_gone_is():
    empty = view(facing(4.0, 2.0))
    assert compare(empty, view(facing(4.0, 2.0), facing(2.0, 0.3)), moved(0.0))[1] == 0
    assert compare(empty, view(facing(4.0, 2.0), facing(2.0, 0.8)), moved(0.0))[1] > 5


def test_far_elements_of_a_wall_hang_together_however_far_apart_they_are():
    far = facing(4.0, 2.0)
    far[:, :3] *= 5.0  # every half metre at 20 m
    assert len(view(far).looks) == len(far)


def test_nothing_is_known_of_what_is_beside_the_field_of_view():
    """A corridor's side wall that the one saw and the other did not look at, at the pose that both have."""
    roof = facing(0.0, 4.0, normal=(0.0, 0.0, -1.0))[:, [1, 2, 0, 3, 4, 5, 6, 7]]
    side, farther = (facing(y, 2.0)[:, [1, 0, 2, 4, 3, 5, 6, 7]] for y in (2.0, 4.0))
    roof[:, :3] += (4.0, 0.0, 2.0)
    side[:, :3] += (4.0, 0.0, -0.3)
    farther[:, :3] += (4.0, 0.0, -0.3)
    roof = roof[np.abs(roof[:, 1]) < 1.8]
    assert compare(view(roof), view(roof, side), moved(0.0)) == (0, 0)
    assert compare(view(roof, farther), view(roof, side), moved(0.0))[1] > 10
