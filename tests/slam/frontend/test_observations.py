"""Lines as planes: the covariance that a laser line gives to the plane through it."""

import numpy as np

from factors.association.observations import LineObservation, PlaneObservation
from slam.geometry.frames import inverse, lift, settle_frame
from slam.geometry.polygons import largest_polygon, polygons_of, segments_of
from spplanes import ScanLine
from spplanes.outlines.extents import grow
from tests.slam.scenes import measured, room_planes
from tests.statistics import assert_mean_in_band

MOUNT = np.array([[0.0, -1.0, 0.0, 0.2], [1.0, 0.0, 0.0, -0.1], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]])


def line(alpha: float, rho: float, covariance: np.ndarray) -> ScanLine:
    along, foot = np.array([-np.sin(alpha), np.cos(alpha)]), rho * np.array([np.cos(alpha), np.sin(alpha)])
    return ScanLine(alpha, rho, covariance, np.array([foot - 0.4 * along, foot + 1.7 * along]), np.arange(30))


def test_plane_of_a_line_is_square_to_the_scan_plane_and_faces_the_sensor():
    seen = LineObservation(line(0.7, 2.0, np.diag([1e-6, 1e-6])), MOUNT)
    plane = seen.full_plane(0.02)
    np.testing.assert_allclose(plane.normal @ MOUNT[:3, 2], 0.0, atol=1e-12)
    assert plane.distance(MOUNT[:3, 3]) > 0.0
    np.testing.assert_allclose(plane.distance(seen.vertices), 0.0, atol=1e-12)
    assert plane.covariance[2, 2] == 0.02**2 and np.linalg.det(plane.frame[:3, :3]) > 0.0


def test_covariance_of_the_plane_is_that_of_the_sampled_line():
    """NEES of (z, theta) over draws of (alpha, rho) with a strong correlation: a flipped sign fails here."""
    rng, covariance, values = np.random.default_rng(0), np.array([[4e-6, 5.5e-6], [5.5e-6, 9e-6]]), []
    root = np.linalg.cholesky(covariance)
    estimate = LineObservation(line(2.4, 3.0, covariance), MOUNT).full_plane(0.01)
    for _ in range(3000):
        alpha, rho = np.array([2.4, 3.0]) + root @ rng.standard_normal(2)
        truth = LineObservation(line(alpha, rho, covariance), MOUNT).full_plane(0.01)
        relative = inverse(estimate.frame) @ truth.frame
        normal = relative[:3, 2]
        error = np.array([normal @ relative[:3, 3] / normal[2], normal[0]])
        values.append(error @ np.linalg.solve(estimate.covariance[:2, :2], error))
    assert_mean_in_band(np.array(values), 2)


def test_patch_of_a_line_is_its_segment():
    seen = LineObservation(line(0.0, 2.0, np.eye(2)), np.eye(4))
    patch = seen.patch_in(inverse(seen.full_plane(0.01).frame))
    assert patch.geom_type == "LineString" and abs(patch.length - 2.1) < 1e-12


def test_plane_frames_follow_an_estimate_the_shortest_way():
    plane = measured(room_planes()[2], np.random.default_rng(1), np.array([0.2, 0.3, 0.3]))
    settled = settle_frame(room_planes()[2].frame, plane.normal, plane.d)
    np.testing.assert_allclose(settled[:3, 2], plane.normal, atol=1e-12)
    assert abs(plane.distance(settled[:3, 3])) < 1e-12
    np.testing.assert_allclose(settled[:3, :3].T @ settled[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(settle_frame(plane.frame, plane.normal, plane.d), plane.frame, atol=1e-12)


def test_outlines_grow_by_union_and_come_apart_again():
    wall, six_metres_on = room_planes()[4], np.eye(4)
    six_metres_on[0, 3] = 6.0
    shifted = PlaneObservation(wall.transform(six_metres_on))
    outline, further = (seen.patch_in(inverse(wall.frame)) for seen in (PlaneObservation(wall), shifted))
    both = grow(outline, further)
    assert abs(both.area - (24.0 + 6.0 * 3.0)) < 1e-9 and largest_polygon(both) is not None
    mixed = grow(both, LineObservation(line(0.0, 2.0, np.eye(2)), np.eye(4)).patch_in(np.eye(4)))
    assert len(polygons_of(mixed)) == 1 and len(segments_of(mixed)) <= 1
    np.testing.assert_allclose(lift(np.zeros((1, 2)), MOUNT), [MOUNT[:3, 3]])


def test_a_wall_that_is_not_straight_shares_its_error_by_patches():
    """Its variance at the middle of the line is that of the mean of its patches, at the ends four times that."""
    covariance = np.array([[4e-6, 5.5e-6], [5.5e-6, 9e-6]])
    plain = line(2.4, 3.0, covariance)
    real = LineObservation(plain, MOUNT).on_uneven_wall(0.01, 0.3).line
    shift = 0.01**2 * (0.3 / 2.1 - 1.0 / 30.0)
    for share, times in ((0.0, 4.0), (0.5, 1.0), (1.0, 4.0)):
        point = plain.endpoints[0] + share * (plain.endpoints[1] - plain.endpoints[0])
        off = np.array([point @ plain.direction, -1.0])  # by which the line passes the point, of (alpha, rho)
        np.testing.assert_allclose(off @ (real.covariance - covariance) @ off, times * shift, rtol=1e-9)


def test_a_wall_without_error_of_its_own_is_the_line_as_it_is():
    """And so is one of fewer points than patches: each is off by itself, which its covariance says already."""
    seen = LineObservation(line(0.7, 2.0, np.diag([1e-6, 1e-6])), MOUNT)
    assert seen.on_uneven_wall(0.0, 0.3) is seen and seen.on_uneven_wall(0.01, 0.01) is seen
