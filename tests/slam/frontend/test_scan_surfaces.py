"""Surface elements lie on the surfaces and edges that a camera saw, and know them as well as their sigma says."""

from __future__ import annotations

import numpy as np

from slam.frontend.scan_surfaces import COLUMNS, ON_EDGE, ON_PLANE, surfaces_of
from tests.slam.depth_scenes import HIGH, LOW, SENSOR, in_world, looking, measured

#: Floor, top and one side of the box: nothing holds the camera along the side.
POSE = looking(-1.5, 0.0, 1.2, 0.0, 0.6)


def test_elements_on_planes_lie_on_floor_top_and_side() -> None:
    elements = measured(POSE, np.random.default_rng(0)).surfaces
    assert elements is not None
    some = elements[elements[:, 7] == ON_PLANE]
    points, normals = in_world(some[:, :3], POSE), some[:, 3:6] @ POSE[:3, :3].T
    assert len(some) > 300
    heights = np.where(normals[:, 2] > 0.9, np.minimum(abs(points[:, 2]), abs(points[:, 2] - HIGH[2])), 0.0)
    fronts = np.where(normals[:, 0] < -0.9, abs(points[:, 0] - LOW[0]), 0.0)
    assert ((normals[:, 2] > 0.99) | (normals[:, 0] < -0.99)).all()
    assert max(heights.max(), fronts.max()) < 0.004


def test_edges_of_the_box_are_found_where_they_are_and_the_border_of_the_image_is_none() -> None:
    elements = measured(POSE, np.random.default_rng(1)).surfaces
    assert elements is not None
    some = elements[elements[:, 7] == ON_EDGE]
    points, across = in_world(some[:, :3], POSE), some[:, 3:6] @ POSE[:3, :3].T
    upright, level = abs(across[:, 2]) < 0.3, abs(across[:, 1]) < 0.3
    assert (abs(abs(points[upright & ~level, 1]) - HIGH[1]) < 0.05).all()  # the sides, to two beams and a bit
    assert (upright & ~level).sum() > 8
    assert (points[:, 2] > -0.01).all() and (points[:, 2] < HIGH[2] + 0.02).all()
    assert (abs(points[:, 1]) < HIGH[1] + 0.02).all()  # none where the floor leaves the picture


def test_a_bare_floor_seen_at_a_grazing_angle_has_no_edges() -> None:
    pose = looking(3.0, 0.0, 0.5, 0.0, 0.25)  # away from the box
    elements = measured(pose, np.random.default_rng(2)).surfaces
    assert elements is not None
    assert not (elements[:, 7] == ON_EDGE).any()


def test_a_scan_without_returns_has_no_elements() -> None:
    points, none = np.full((4, 5, 3), np.nan), np.full((4, 5), -1)
    assert surfaces_of(points, none, np.empty((0, 4)), SENSOR).shape == (0, COLUMNS)
