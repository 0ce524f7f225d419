import numpy as np
import pytest

from spplanes.noise import DepthCameraModel, SensorModel


def test_covariance_has_range_error_along_and_bearing_error_across():
    model = SensorModel(range_sigma_m=0.01, bearing_sigma_rad=0.002)
    points = np.array([[[3.0, 4.0, 0.0], [np.nan, np.nan, np.nan]]])
    covariances = model.covariances(points)
    u, v = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
    assert u @ covariances[0, 0] @ u == pytest.approx(1e-4)
    assert v @ covariances[0, 0] @ v == pytest.approx(1e-4)
    assert covariances[0, 0, 2, 2] == pytest.approx(1e-4)
    assert np.isnan(covariances[0, 1]).all()
    moved = model.covariances(points + 1.0, viewpoints=(1.0, 1.0, 1.0))
    np.testing.assert_allclose(moved[0, 0], covariances[0, 0])


def test_range_variance_adds_its_parts():
    model = SensorModel(0.01, range_sigma_share=0.002, quantisation_m=0.012, beam_divergence_rad=0.01)
    assert model.range_variance(0.0) == pytest.approx(1e-4 + 0.012**2 / 12)
    assert model.range_variance(5.0) == pytest.approx(1e-4 + 0.012**2 / 12 + 1e-4)
    slanted = model.range_variance(5.0, np.pi / 4) - model.range_variance(5.0)
    assert slanted == pytest.approx((5.0 * 0.01) ** 2 / 16.0)


def test_scan_covariance_is_shift_and_tilt():
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
