"""Surface elements lie on the surfaces and edges that a camera saw, as sure as they say; kernels against numpy."""

import numpy as np

from slam.frontend._surface_kernels import jumps
from slam.frontend.scan_surfaces import ON_EDGE, ON_PLANE, WIDTH, surfaces_of
from slam.geometry.frames import lift
from tests.slam.depth_scenes import HIGH, LOW, SENSOR, looking, measured
from tests.spplanes.scenes import spun

#: Floor, top and one side of the box: nothing holds the camera along the side.
POSE = looking(-1.5, 0.0, 1.2, 0.0, 0.6)


def elements_seen(kind: float, pose: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and directions in the world of the elements of a kind, seen from a pose."""
    elements = measured(pose, np.random.default_rng(seed)).surfaces
    assert elements is not None
    some = elements[elements[:, 7] == kind]
    return lift(some[:, :3], pose), some[:, 3:6] @ pose[:3, :3].T


def test_elements_on_planes_lie_on_floor_top_and_side() -> None:
    points, normals = elements_seen(ON_PLANE, POSE, 0)
    assert len(points) > 300
    heights = np.where(normals[:, 2] > 0.9, np.minimum(abs(points[:, 2]), abs(points[:, 2] - HIGH[2])), 0.0)
    fronts = np.where(normals[:, 0] < -0.9, abs(points[:, 0] - LOW[0]), 0.0)
    assert ((normals[:, 2] > 0.99) | (normals[:, 0] < -0.99)).all() and max(heights.max(), fronts.max()) < 0.004


def test_edges_of_the_box_are_found_where_they_are_and_the_border_of_the_image_is_none() -> None:
    points, across = elements_seen(ON_EDGE, POSE, 1)
    upright, level = abs(across[:, 2]) < 0.3, abs(across[:, 1]) < 0.3
    assert (abs(abs(points[upright & ~level, 1]) - HIGH[1]) < 0.05).all()  # the sides, to two beams and a bit
    assert (upright & ~level).sum() > 8 and (points[:, 2] > -0.01).all() and (points[:, 2] < HIGH[2] + 0.02).all()
    assert (abs(points[:, 1]) < HIGH[1] + 0.02).all()  # none where the floor leaves the picture


def test_a_bare_floor_seen_at_a_grazing_angle_has_no_edges() -> None:
    away_from_the_box = looking(3.0, 0.0, 0.5, 0.0, 0.25)
    assert len(elements_seen(ON_EDGE, away_from_the_box, 2)[0]) == 0


def test_elements_are_as_wide_as_beams_are_apart() -> None:
    """Most of a wall is in elements, whether beams are a fifth of a degree apart or three."""
    for apart_deg in (0.2, 1.0, 3.0):
        angles = np.deg2rad(np.arange(-30.0, 30.0, apart_deg))
        rays = spun(angles, angles)
        points = 4.0 * rays / rays[..., :1]
        found = surfaces_of(points, np.zeros(points.shape[:2], dtype=int), np.array([[1.0, 0.0, 0.0, 4.0]]), SENSOR)
        ranges = np.linalg.norm(found[:, :3] - SENSOR.body_T_sensor[:3, 3], axis=1)
        share = max(0.06, 2.0 * np.sqrt(3.0) * np.deg2rad(apart_deg))
        np.testing.assert_allclose(found[:, WIDTH], share * ranges, rtol=0.06)
        covered = found[:, WIDTH] ** 2  # a cube is that wide, or down to half of it
        assert 0.7 < covered.sum() / np.ptp(points.reshape(-1, 3), axis=0)[1:].prod() < 4.5


def test_a_jump_lies_between_the_last_beam_on_the_near_side_and_the_next() -> None:
    angles, near = np.linspace(-0.1, 0.1, 21), np.arange(21) < 10
    ranges, rays = np.where(near, 2.0, 5.0), np.column_stack((np.cos(angles), np.sin(angles), np.zeros(21)))
    points, none = rays * ranges[:, None], np.full(21, -1)
    edge = 0.5 * (angles[9] + angles[10])
    middle = 2.0 * np.array([np.cos(edge), np.sin(edge), 0.0])
    forth, back = (1, 21, 21, 1, 0), (1, 21, 21, -1, 20)
    np.testing.assert_allclose(jumps(points, ranges, none, forth, 0), [middle], atol=1e-12)
    assert not len(jumps(points, ranges, none, back, 0))  # from there it comes nearer
    np.testing.assert_array_equal(jumps(points, ranges, none, forth, 2), points[7:8])
    assert not len(jumps(points, ranges, np.zeros(21, dtype=np.int64), forth, 0))  # one plane, seen at a slant
    ranges[9] = np.nan
    np.testing.assert_array_equal(jumps(points, ranges, none, forth, 0), points[8:9])  # the edge may be anywhere
    ranges[1:10] = np.nan
    assert not len(jumps(points, ranges, none, forth, 0))  # beyond 0.08 rad nobody knows
