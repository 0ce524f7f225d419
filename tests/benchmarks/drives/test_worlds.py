"""Random buildings are closed, clear where the robot goes, hit where their true planes are; polygons by hand."""

import numpy as np
import pytest

from benchmarks.corpus.drives import WORLDS
from benchmarks.corpus.polygon_world import PolygonBuilder
from slam.simulation.robots import Beams
from spplanes.registration import beam_directions
from tests.slam.simulation.test_raycast import cast_one

BEAMS = Beams.of_spinning(np.linspace(-np.pi, np.pi, 90, endpoint=False), np.deg2rad(np.linspace(-60, 80, 15)))


def seen_along(scene, height_m=0.8):
    """Origins (S, 3), rays (S, B, 3), ranges (S, B), labels (S, B) of a few looks round on the way of a scene."""
    way = np.linspace(0.0, scene.course.length_m, 9)
    poses = scene.course.poses_at(way)
    origins = np.repeat(poses[:, :3, 3] + height_m * poses[:, :3, 2], len(BEAMS.normals), axis=0)
    rays = np.concatenate([BEAMS.directions @ pose[:3, :3].T for pose in poses])
    normals = np.concatenate([BEAMS.normals @ pose[:3, :3].T for pose in poses])
    return origins, rays, *scene.cast(origins, rays, normals, np.repeat(way / 0.5, len(BEAMS.normals)))


@pytest.mark.parametrize("kind", WORLDS)
@pytest.mark.parametrize("seed", [0, 1])
def test_what_is_hit_lies_on_the_true_plane_and_nothing_looks_out(kind, seed):
    scene = WORLDS[kind](np.random.default_rng(seed))
    origins, rays, ranges, labels = seen_along(scene)
    hits = (origins[:, None] + ranges[..., None] * rays)[labels >= 0]
    normals = np.array([plane.normal for plane in scene.world.planes])[labels[labels >= 0]]
    offsets = np.array([plane.d for plane in scene.world.planes])[labels[labels >= 0]]
    assert np.abs(np.einsum("ni,ni->n", hits, normals) - offsets).max() < 1e-9
    assert (np.einsum("ni,ni->n", rays[labels >= 0], normals) < 0.0).mean() > 0.97  # seen from the side they face
    away = np.isinf(ranges).mean()
    assert away == 0.0 if kind != "glass" else 0.01 < away < 0.6


@pytest.mark.parametrize("kind", WORLDS)
def test_the_way_is_clear_of_walls_and_furniture(kind):
    scene = WORLDS[kind](np.random.default_rng(5))
    scene = type(scene)(scene.world, scene.course)  # without people
    _, rays, ranges, _ = seen_along(scene, height_m=0.3)
    across = ranges * np.linalg.norm(rays[..., :2], axis=-1)
    assert across[np.abs(rays[..., 2]) < 0.3].min() > 0.4


def test_a_ramp_leads_from_one_floor_to_the_one_above():
    scene = WORLDS["ramp"](np.random.default_rng(0))
    assert not scene.course.level
    poses = scene.course.poses_at(np.linspace(0.0, scene.course.length_m, 2000))
    assert poses[0, 2, 3] == pytest.approx(0.0, abs=1e-9) and 2.8 < poses[-1, 2, 3] < 3.3
    assert np.abs(np.diff(poses[:, 2, 3])).max() < 0.01  # no steps
    turns = poses[:, :3, :3]
    np.testing.assert_allclose(turns @ turns.transpose(0, 2, 1), np.tile(np.eye(3), (2000, 1, 1)), atol=1e-12)
    forward = np.diff(poses[:, :3, 3], axis=0)
    along = np.einsum("ni,ni->n", forward / np.linalg.norm(forward, axis=1)[:, None], poses[:-1, :3, 0])
    assert along.min() > 0.99  # it drives where it looks, uphill as well


def test_people_come_before_walls_and_move():
    scene = WORLDS["people"](np.random.default_rng(2))
    _, _, with_people, labels = seen_along(scene)
    _, _, without, _ = seen_along(type(scene)(scene.world, scene.course))
    nearer = with_people < without
    assert (with_people <= without).all() and 0.002 < nearer.mean() < 0.3 and (labels[nearer] == -1).all()
    places = scene.walkers[0].places(scene.course.path, np.array([0.0, 1.0]))
    assert 0.3 < np.linalg.norm(places[1] - places[0]) < 2.5


def test_a_polygon_with_a_hole_is_a_rectangle_with_that_hole():
    polygon, rectangle = PolygonBuilder(), PolygonBuilder()
    outer, hole = [(2, -1, 0), (2, 3, 0), (2, 3, 3), (2, -1, 3)], [(2, 0, 1), (2, 1, 1), (2, 1, 2), (2, 0, 2)]
    polygon.add_polygon([outer, hole], toward=(0, 0, 0))
    rectangle.add_patch((2, -1, 0), (0, 4, 0), (0, 0, 3), toward=(0, 0, 0), holes=[(1, 1, 2, 2)])
    directions = beam_directions(np.linspace(-1.4, 1.4, 301))
    tilt = np.array([[np.cos(t), 0, -np.sin(t), 0, 1, 0, np.sin(t), 0, np.cos(t)] for t in np.linspace(-1.0, 1.0, 41)])
    rays = directions @ tilt.reshape(-1, 3, 3).transpose(0, 2, 1)
    origins, normals = np.tile((0.0, 0.4, 1.5), (41, 1)), tilt.reshape(-1, 3, 3)[:, :, 2]
    by_polygon, by_rectangle = (one.build().cast(origins, rays, normals) for one in (polygon, rectangle))
    np.testing.assert_allclose(by_polygon[0], by_rectangle[0])
    assert np.array_equal(by_polygon[1], by_rectangle[1]) and 0.1 < np.isinf(by_polygon[0]).mean() < 0.9


def test_glass_stops_a_beam_and_sends_nothing_back():
    builder = PolygonBuilder()
    builder.add_patch((3.0, -9.0, -9.0), (0, 18, 0), (0, 0, 18), toward=(0, 0, 0))
    builder.add_polygon([[(2, -1, 0), (2, 3, 0), (2, 3, 3), (2, -1, 3)]], toward=(0, 0, 0), glass=True)
    world = builder.build()
    assert cast_one(world, (0, 0, 1), (1, 0, 0)) == (np.inf, -1) and cast_one(world, (0, 0, -1), (1, 0, 0)) == (3.0, 0)
    assert len(world.planes) == 1


def test_patches_of_a_wall_that_lie_apart_are_one_plane_with_the_hull_for_outline():
    builder = PolygonBuilder()
    wall = builder.add_polygon([[(0, 2, 0), (1, 2, 0), (1, 2, 2), (0, 2, 2)]], toward=(0, 0, 0))
    builder.add_polygon([[(3, 2, 0), (4, 2, 0), (4, 2, 2), (3, 2, 2)]], toward=(0, 0, 0), plane=wall)
    (plane,) = builder.build().planes
    assert plane.outline.area == pytest.approx(8.0) and plane.normal @ (0, -1, 0) == pytest.approx(1.0)
