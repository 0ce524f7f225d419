"""Facing planes: distance, angle, and a standard deviation that holds."""

import numpy as np
from shapely import Polygon, box

from slam.evaluation import facing_pairs
from slam.planeslam import MapPlane
from spplanes import Plane
from spplanes.spmodel import transform_from_rpy
from tests.slam.scenes import measured, room_planes
from tests.statistics import assert_mean_in_band

SIGMAS = np.array([0.004, 0.003, 0.005])


def map_plane(number: int, plane: Plane, seen: Polygon | None = None) -> MapPlane:
    outline = plane.outline if seen is None else seen
    assert outline is not None
    return MapPlane(number, plane, outline, 2, ("plane",))


def test_a_room_has_a_height_and_two_widths():
    pairs = facing_pairs([map_plane(number, plane) for number, plane in enumerate(room_planes())])
    assert [(pair.first, pair.second) for pair in pairs] == [(0, 1), (4, 5), (2, 3)]
    assert [pair.name for pair in pairs] == ["height", "width", "width"]
    np.testing.assert_allclose([pair.distance_m for pair in pairs], [3.0, 6.0, 8.0])
    np.testing.assert_allclose([pair.overlap_m2 for pair in pairs], [48.0, 24.0, 18.0])
    np.testing.assert_allclose([pair.angle_deg for pair in pairs], 0.0, atol=1e-5)


def test_planes_back_to_back_or_side_by_side_do_not_face_each_other():
    floor, ceiling = room_planes()[:2]
    for beside_or_below in ((20.0, 0.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, -9.0, 0.0, 0.0, 0.0)):
        other = ceiling.transform(transform_from_rpy(beside_or_below))
        assert facing_pairs([map_plane(0, floor), map_plane(1, other)]) == []


def test_the_standard_deviation_of_a_gap_away_from_the_centres_is_that_of_samples():
    """Overlap in one corner only, cross terms in the covariance: signs of the lever arms matter."""
    rng, corner, values = np.random.default_rng(0), box(2.0, 1.0, 4.0, 3.0), []
    floor, ceiling = room_planes()[:2]
    covariance = np.diag(SIGMAS**2) + np.outer([0.01, 0.004, 0.0], [0.01, 0.004, 0.0])
    for _ in range(1500):
        frame, shift = measured(floor, rng, SIGMAS).frame, rng.standard_normal()
        frame = frame @ transform_from_rpy((0.0, 0.0, 0.01 * shift, 0.0, 0.004 * shift, 0.0))
        low, high = Plane(frame, covariance, 500, corner), measured(ceiling, rng, SIGMAS)
        pairs = facing_pairs([map_plane(0, low, corner), map_plane(1, high)])
        values.append(((pairs[0].distance_m - 3.0) / pairs[0].sigma_m) ** 2)
    assert_mean_in_band(np.array(values), 1)


def test_the_gap_is_told_where_it_is_known_best():
    """Floor and ceiling open by 0.01: told at the middle of the ceiling, or at the nearest place that was seen."""
    slope = 0.01
    low = Plane(np.eye(4), np.diag([0.001, 0.002, 0.002]) ** 2, 100, box(-10.0, -1.0, 10.0, 1.0))
    frame = np.eye(4)
    frame[:3, :3] = np.array([[1.0, 0.0, slope], [0.0, -1.0, 0.0], [slope, 0.0, -1.0]]) / np.hypot(1.0, slope)
    frame[:3, 1] = [0.0, -1.0, 0.0]
    frame[:3, 3] = [-6.0, 0.0, 2.0 - 6.0 * slope]
    for begins_at, told_at in ((-4.0, 6.0), (0.0, 6.0), (5.0, 1.0)):
        high = Plane(frame, np.diag([0.0001, 0.02, 0.02]) ** 2, 100, box(begins_at, -1.0, 16.0, 1.0))
        [pair] = facing_pairs([map_plane(0, low), map_plane(1, high)])
        assert abs(pair.distance_m - (2.0 - told_at * slope)) < 1e-3
