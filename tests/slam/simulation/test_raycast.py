"""Ray casting against cases solved by hand and against a slow independent solution."""

import numpy as np
import pytest
import shapely

from slam.simulation import WorldBuilder
from slam.simulation.buildings import corridor, office
from spplanes.registration import beam_directions


def cast_one(world, origin, ray):
    ray = np.asarray(ray, dtype=float) / np.linalg.norm(ray)
    ranges, labels = world.cast(np.array([origin], dtype=float), ray[None, None], np.zeros((1, 3)))
    return ranges[0, 0], labels[0, 0]


def wall_world(**options):
    builder = WorldBuilder()
    builder.add_patch((2.0, -1.0, 0.0), (0, 4.0, 0), (0, 0, 3.0), toward=(0, 0, 0), **options)
    return builder.build()


@pytest.mark.parametrize(
    ("origin", "ray", "expected"),
    [
        ((0, 0, 1), (1, 0, 0), 2.0),
        ((0, 0, 1), (1, 1, 0), 2.0 * np.sqrt(2.0)),
        ((0, 0, 1), (2, 0, 1.5), 2.5),
        ((4, 0, 1), (-1, 0, 0), 2.0),  # from behind as well
        ((0, 0, 1), (-1, 0, 0), np.inf),  # looking away
        ((0, 0, 1), (0, 1, 0), np.inf),  # parallel
        ((0, -1.001, 1), (1, 0, 0), np.inf),  # just past an edge
        ((0, -0.999, 1), (1, 0, 0), 2.0),
        ((0, 0, 3.001), (1, 0, 0), np.inf),
        ((2, 0, 1), (1, 0, 0), np.inf),  # starting on the surface
    ],
)
def test_range_to_a_rectangle(origin, ray, expected):
    distance, label = cast_one(wall_world(), origin, ray)
    assert distance == pytest.approx(expected, abs=1e-12) and label == (0 if np.isfinite(expected) else -1)


@pytest.mark.parametrize(("y", "z", "hit"), [(0.5, 0.5, False), (-0.5, 0.5, True), (0.5, 2.5, True), (2.5, 1.0, True)])
def test_holes_let_rays_through(y, z, hit):
    world = wall_world(holes=[(1.0, 0.0, 2.0, 2.0)])  # y from 0 to 1, z from 0 to 2
    assert np.isfinite(cast_one(world, (0, y, z), (1, 0, 0))[0]) == hit
    assert world.planes[0].outline.area == pytest.approx(4.0 * 3.0 - 2.0)


@pytest.mark.parametrize("offset", [0.0, 0.3, 0.4999, 0.5001])
def test_range_to_a_round_bar(offset):
    builder = WorldBuilder()
    builder.add_bar((3.0, 0.0, 0.0), (3.0, 0.0, 2.0), 0.5)
    distance, label = cast_one(builder.build(), (0.0, offset, 1.0), (1, 0, 0))
    expected = 3.0 - np.sqrt(0.25 - offset**2) if offset < 0.5 else np.inf
    assert distance == pytest.approx(expected, abs=1e-12) and label == -1


def test_a_box_shows_its_outside():
    builder = WorldBuilder()
    labels, world = builder.add_box((1.0, 2.0, 0.0), (3.0, 5.0, 1.0), hidden=["z-"]), builder.build()
    assert labels == [0, 1, 2, 3, 4]
    normals = {tuple(plane.normal.round(12) + 0.0) for plane in world.planes}
    assert normals == {(-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, 1)}
    assert sorted(plane.d for plane in world.planes) == [-2.0, -1.0, 1.0, 3.0, 5.0]
    assert sorted(plane.outline.area for plane in world.planes) == pytest.approx([2.0, 2.0, 3.0, 3.0, 6.0])


def slow_ranges(world, origin, rays):
    """Nearest rectangle by plain linear algebra: solve origin + t ray = corner + a u + b v."""
    best = np.full(len(rays), np.inf)
    for corner, u, v in world.rectangles:
        for k, ray in enumerate(rays):
            matrix = np.column_stack([ray, -u, -v])
            if abs(np.linalg.det(matrix)) > 1e-12:
                t, a, b = np.linalg.solve(matrix, corner - origin)
                if t > 1e-6 and 0.0 <= a <= 1.0 and 0.0 <= b <= 1.0:
                    best[k] = min(best[k], t)
    return best


def test_a_corridor_scan_agrees_with_linear_algebra():
    world, rays = corridor(20.0), beam_directions(np.deg2rad(np.arange(-180, 180, 7.3)))
    origin = np.array([4.3, 0.1, 1.5])  # in front of the open chamber, above the closets, clear of the bars
    ranges, _ = world.cast(origin[None], rays[None], np.array([[0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(ranges[0], slow_ranges(world, origin, rays), atol=1e-9)


def test_leaving_out_what_a_scan_plane_cannot_meet_changes_nothing():
    rng, world = np.random.default_rng(3), office()
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    rotation[:, 2] = np.cross(rotation[:, 0], rotation[:, 1])
    rays = beam_directions(np.linspace(-3.0, 3.0, 200)) @ rotation.T
    origin = np.array([[1.0, 0.2, 0.7]])
    fast, full = (world.cast(origin, rays[None], normal) for normal in (rotation[None, :, 2].copy(), np.zeros((1, 3))))
    for one, other in zip(fast, full, strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.isfinite(full[0]).all()


def test_worlds_are_closed():
    rays = np.random.default_rng(5).standard_normal((1, 4000, 3))
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    for world in (corridor(20.0), office()):
        ranges, _ = world.cast(np.array([[0.5, 0.0, 1.0]]), rays, np.zeros((1, 3)))
        assert np.isfinite(ranges).all()


@pytest.mark.parametrize("world", [corridor(29.3), office()])
def test_no_two_true_planes_are_one(world):
    """Coplanar patches that touch must share a label, or a mapper that joins them would be counted wrong."""
    for i, a in enumerate(world.planes):
        for b in world.planes[i + 1 :]:
            if a.normal @ b.normal > 1.0 - 1e-9 and abs(a.distance(b.centre)) < 1e-6:
                mapped = np.array(b.outline.exterior.coords) @ b.frame[:3, :2].T + b.centre
                assert a.outline.distance(shapely.Polygon((mapped - a.centre) @ a.frame[:3, :2])) > 0.01
