"""Noise models of sensors, and scans registered by poses: where points are and what they share of errors."""

import numpy as np
import pytest

from spplanes.noise import DepthCameraModel, SensorModel
from spplanes.registration import interpolate_poses, pose_covariance, register_scans
from spplanes.spmodel import transform_from_rpy


def pose(x=0.0, y=0.0, yaw=0.0):
    return transform_from_rpy((x, y, 0.0, yaw, 0.0, 0.0))


def test_poses_between_are_on_the_way():
    poses = np.stack((pose(), pose(2.0, 1.0, 0.4)))
    between = interpolate_poses([0, 10], poses, [0, 5, 10])
    np.testing.assert_allclose(between[0], poses[0], atol=1e-12)
    np.testing.assert_allclose(between[1], pose(1.0, 0.5, 0.2), atol=1e-12)
    np.testing.assert_allclose(between[2], poses[1], atol=1e-12)
    np.testing.assert_allclose(interpolate_poses([3], poses[:1], [3, 3]), [poses[0]] * 2)


@pytest.mark.parametrize(
    ("stamps", "at", "message"),
    [
        ([10, 0], [5], "stamps_ns: expected ascending times, got 0 after 10"),
        ([0, 10], [11], "at_ns: expected times from 0 to 10, got 11 to 11"),
        ([0], [0], "stamps_ns: expected one time per pose"),
    ],
)
def test_poses_out_of_order_or_range(stamps, at, message):
    with pytest.raises(ValueError, match=message):
        interpolate_poses(stamps, np.stack((pose(), pose(1.0))), at)


def test_points_are_pose_mount_and_beam():
    ranges, mount = [[2.0, np.nan, 0.0, np.inf]], transform_from_rpy((0.0, 0.0, 0.5, 0.0, 0.0, 0.0))
    poses, bearings = pose(1, 2, np.pi / 2)[None], [0.0, 0.1, 0.2, 0.3]
    scans = register_scans(ranges, bearings, poses, SensorModel(0.01), body_T_sensor=mount)
    np.testing.assert_allclose(scans.points[0, 0], [1.0, 4.0, 0.5])
    assert np.isnan(scans.points[0, 1:]).all()
    np.testing.assert_allclose(scans.viewpoints, [[1.0, 2.0, 0.5]])
    np.testing.assert_allclose(scans.scan_origins, [[1.0, 2.0, 0.0]])
    np.testing.assert_allclose(scans.covariances[0, 0], np.diag([0, 1e-4, 0]), atol=1e-18)
    assert scans.pose_covariances is None


def test_pose_error_stays_beside_the_points_unless_folded():
    error = pose_covariance(np.diag([1e-4, 4e-4, 1e-6]))
    args = [[2.0]], [0.0], np.eye(4)[None], SensorModel(0.01)
    beside = register_scans(*args, pose_covariances=error)
    folded = register_scans(*args, pose_covariances=error, fold_pose=True)
    np.testing.assert_allclose(beside.pose_covariances, error[None])
    np.testing.assert_allclose(beside.covariances[0, 0], np.diag([1e-4, 0, 0]), atol=1e-18)
    np.testing.assert_allclose(folded.covariances[0, 0], np.diag([2e-4, 4e-4 + 4e-6, 0]), atol=1e-18)
    assert folded.pose_covariances is None


def test_errors_of_the_mount_move_to_the_body():
    mount = transform_from_rpy((0.3, -0.2, 0.5, 0.0, 0.0, 0.0))
    model = SensorModel(0.01, scan_tilt_sigma_rad=0.02, scan_shift_sigma_m=0.01)
    scans = register_scans([[2.0, 3.0]], [0.3, 1.0], pose(1, 2, 0.7)[None], model, body_T_sensor=mount)
    for point in scans.points[0]:
        about_body, about_sensor = (
            np.column_stack((np.eye(3), *np.cross(np.eye(3)[::-1], point - origin)))
            for origin in (scans.scan_origins[0], scans.viewpoints[0])
        )
        expected = about_sensor @ model.scan_covariance() @ about_sensor.T
        np.testing.assert_allclose(about_body @ scans.pose_covariances[0] @ about_body.T, expected, atol=1e-15)


def test_covariance_has_range_error_along_and_bearing_error_across():
    model = SensorModel(range_sigma_m=0.01, bearing_sigma_rad=0.002)
    points = np.array([[[3.0, 4.0, 0.0], [np.nan, np.nan, np.nan]]])
    covariances = model.covariances(points)
    for axis in np.array([[0.6, 0.8, 0.0], [-0.8, 0.6, 0.0], [0.0, 0.0, 1.0]]):
        assert axis @ covariances[0, 0] @ axis == pytest.approx(1e-4)
    assert np.isnan(covariances[0, 1]).all()
    moved = model.covariances(points + 1.0, viewpoints=(1.0, 1.0, 1.0))
    np.testing.assert_allclose(moved[0, 0], covariances[0, 0])


def test_range_variance_adds_its_parts_and_scan_covariance_is_shift_and_tilt():
    model = SensorModel(0.01, range_sigma_share=0.002, quantisation_m=0.012, beam_divergence_rad=0.01)
    assert model.range_variance(0.0) == pytest.approx(1e-4 + 0.012**2 / 12)
    assert model.range_variance(5.0) == pytest.approx(1e-4 + 0.012**2 / 12 + 1e-4)
    slanted = model.range_variance(5.0, np.pi / 4) - model.range_variance(5.0)
    assert slanted == pytest.approx((5.0 * 0.01) ** 2 / 16.0)
    model = SensorModel(0.01, scan_shift_sigma_m=0.02, scan_tilt_sigma_rad=0.01)
    np.testing.assert_allclose(np.diag(model.scan_covariance()), [4e-4] * 3 + [1e-4] * 3)


def test_depth_camera_errs_along_the_ray_by_its_depth():
    model = DepthCameraModel()
    point = np.array([[[0.4, -0.2, 2.0]]])
    covariance = model.covariances(point)[0, 0]
    sigma = 0.0012 + 0.0019 * 1.6**2
    assert covariance[2, 2] == pytest.approx(sigma**2)
    np.testing.assert_allclose(covariance, np.outer(point, point) * (sigma / 2.0) ** 2)
    assert np.isnan(model.covariances(np.full((1, 1, 3), np.nan))).all()
