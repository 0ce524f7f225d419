"""Polygons of worlds against rectangles and cases solved by hand."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.corpus.polygon_world import PolygonBuilder
from spplanes.registration import beam_directions
from tests.slam.simulation.test_raycast import cast_one


def square_with_a_hole(**options):
    builder = PolygonBuilder()
    outer = [(2, -1, 0), (2, 3, 0), (2, 3, 3), (2, -1, 3)]
    hole = [(2, 0, 1), (2, 1, 1), (2, 1, 2), (2, 0, 2)]
    builder.add_polygon([outer, hole], toward=(0, 0, 0), **options)
    return builder.build()


def test_a_polygon_with_a_hole_is_a_rectangle_with_that_hole():
    builder = PolygonBuilder()
    builder.add_patch((2, -1, 0), (0, 4, 0), (0, 0, 3), toward=(0, 0, 0), holes=[(1, 1, 2, 2)])
    directions = beam_directions(np.linspace(-1.4, 1.4, 301))
    tilt = np.array([[np.cos(t), 0, -np.sin(t), 0, 1, 0, np.sin(t), 0, np.cos(t)] for t in np.linspace(-1.0, 1.0, 41)])
    rays = directions @ tilt.reshape(-1, 3, 3).transpose(0, 2, 1)
    origins, normals = np.tile((0.0, 0.4, 1.5), (41, 1)), tilt.reshape(-1, 3, 3)[:, :, 2]
    by_polygon, by_rectangle = (world.cast(origins, rays, normals) for world in (square_with_a_hole(), builder.build()))
    np.testing.assert_allclose(by_polygon[0], by_rectangle[0])
    assert np.array_equal(by_polygon[1], by_rectangle[1])
    assert 0.1 < np.isinf(by_polygon[0]).mean() < 0.9


def test_glass_stops_a_beam_and_sends_nothing_back():
    builder = PolygonBuilder()
    builder.add_patch((3.0, -9.0, -9.0), (0, 18, 0), (0, 0, 18), toward=(0, 0, 0))
    builder.add_polygon([[(2, -1, 0), (2, 3, 0), (2, 3, 3), (2, -1, 3)]], toward=(0, 0, 0), glass=True)
    world = builder.build()
    assert cast_one(world, (0, 0, 1), (1, 0, 0)) == (np.inf, -1)
    assert cast_one(world, (0, 0, -1), (1, 0, 0)) == (3.0, 0)
    assert len(world.planes) == 1


def test_patches_of_a_wall_that_lie_apart_are_one_plane_with_the_hull_for_outline():
    builder = PolygonBuilder()
    wall = builder.add_polygon([[(0, 2, 0), (1, 2, 0), (1, 2, 2), (0, 2, 2)]], toward=(0, 0, 0))
    builder.add_polygon([[(3, 2, 0), (4, 2, 0), (4, 2, 2), (3, 2, 2)]], toward=(0, 0, 0), plane=wall)
    (plane,) = builder.build().planes
    assert plane.outline.area == pytest.approx(8.0)
    assert plane.normal @ (0, -1, 0) == pytest.approx(1.0)
