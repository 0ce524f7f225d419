"""Quaternions of files (one check for all readers) and the kernel that asks whether polygons come near."""

import numpy as np
import pytest
import shapely
from shapely import affinity
from shapely.geometry.base import BaseGeometry

from slam.geometry.frames import norms_of, poses_of
from slam.registration._plane_arrays import Rings
from slam.registration._plane_kernels import come_near

QUARTER = [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]


def test_a_quarter_turn_is_one():
    (pose,) = poses_of(np.array([[1.0, 2.0, 3.0, *QUARTER]]))
    np.testing.assert_allclose(pose[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    np.testing.assert_array_equal(pose[:3, 3], [1.0, 2.0, 3.0])
    (pose,) = poses_of(np.array([[0.0, 0.0, 0.0, *np.round(QUARTER, 4)]]))  # four digits are enough, and normalised
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-15)


@pytest.mark.parametrize("wrong", [[0.0] * 4, [0.0, 0.0, 1.0, 1.0], [np.nan, 0.0, 0.0, 1.0], [1e200, 0.0, 0.0, 1e200]])
def test_what_is_no_unit_is_told(wrong: list[float]):
    assert norms_of(np.array([wrong, QUARTER]))[1].tolist() == [True, False]
    with pytest.raises(ValueError, match="unit quaternion"):
        poses_of(np.array([[0.0, 0.0, 0.0, *QUARTER], [0.0, 0.0, 0.0, *wrong]]))


def test_a_position_that_is_nowhere_is_told():
    with pytest.raises(ValueError, match="finite positions"):
        poses_of(np.array([[np.inf, 0.0, 0.0, *QUARTER]]))


def blob(rng: np.random.Generator) -> BaseGeometry:
    """A star of some corners, now and then with a hole, or of two parts."""
    turns = np.sort(rng.uniform(0.0, 2.0 * np.pi, int(rng.integers(3, 12))))
    corners = np.column_stack((np.cos(turns), np.sin(turns))) * rng.uniform(0.4, 1.5, (len(turns), 1))
    star: BaseGeometry = shapely.Polygon(corners)
    star = star if star.is_valid else star.buffer(0.0)
    kind = rng.integers(4)
    if kind == 0:
        star = star.difference(star.buffer(-0.2))
    elif kind == 1:
        star = star.union(affinity.translate(star, 3.0, 0.5))
    return affinity.translate(star, *rng.uniform(-2.0, 2.0, 2))


def test_polygons_come_near_where_their_distance_says_so() -> None:
    rng, near, inside = np.random.default_rng(1), 0, 0
    for _ in range(3000):
        one, other, gap = blob(rng), blob(rng), float(rng.choice([0.0, 0.1, 0.5]))
        if one.is_empty or other.is_empty:
            continue
        other = affinity.scale(other, *rng.choice([0.2, 1.0], 2))
        rings = Rings.of_all([one, other])
        ends = [rings.ends[rings.of[k] : rings.of[k + 1] + 1] for k in (0, 1)]
        corners = [rings.corners[end[0] : end[-1]] for end in ends]
        found = come_near(corners[0], ends[0] - ends[0][0], corners[1], ends[1] - ends[1][0], gap)
        distance = one.distance(other)
        if abs(distance - gap) > 1e-9:
            assert found == (distance <= gap)
        near += found
        inside += one.contains(other)
    assert 500 < near < 2500 and inside > 10


def test_a_polygon_in_the_hole_of_another_is_away_from_it() -> None:
    ring = shapely.box(-4, -4, 4, 4).difference(shapely.box(-3, -3, 3, 3))
    rings = Rings.of_all([ring, shapely.box(-1, -1, 1, 1), None, shapely.Polygon()])
    assert rings.of.tolist() == [0, 2, 3, 3, 3] and rings.ends.tolist() == [0, 5, 10, 15]
    parts = rings.corners[:10], rings.ends[:3], rings.corners[10:], rings.ends[2:] - 10
    assert not come_near(*parts, 1.9) and come_near(*parts, 2.0)
    assert not come_near(*parts[:2], np.empty((0, 2)), np.zeros(1, dtype=np.int64), 5.0)
