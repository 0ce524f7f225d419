"""Views of 3D sensors: walls are looked for, seen through where nothing is, and what may walk is no wall."""

import numpy as np

from slam.diagnostics.views import ScanView, compare
from slam.frontend.scan_surfaces import ON_EDGE, ON_NO_PLANE, ON_PLANE
from slam.registration.visibility import Scan
from spplanes._check import FloatArray
from tests.slam.depth_scenes import with_widths

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
    pose = np.eye(4)
    pose[0, 3] = x
    return pose


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
