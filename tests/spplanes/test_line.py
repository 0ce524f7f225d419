"""ScanLine: the SP form and the change of frame, against central differences of the geometry itself."""

import numpy as np
import pytest

from spplanes import ScanLine
from spplanes.spmodel import transform_from_rpy
from tests.statistics import central_differences

COVARIANCE = np.array([[4e-4, 3e-4], [3e-4, 9e-4]])


def make_line(alpha=0.7, rho=2.0, covariance=COVARIANCE, along=(-0.5, 1.5)):
    normal, direction = np.array((np.cos(alpha), np.sin(alpha))), np.array((-np.sin(alpha), np.cos(alpha)))
    endpoints = np.array([rho * normal + t * direction for t in along])
    return ScanLine(alpha, rho, covariance, endpoints, np.arange(5))


def planar(x, y, theta):
    return transform_from_rpy((x, y, 0.0, theta, 0.0, 0.0))


def polar_of_frame(frame):
    """(alpha, rho) of the x axis of a frame, its y axis pointing to the sensor."""
    normal = -frame[:2, 1]
    return np.array((np.arctan2(normal[1], normal[0]), normal @ frame[:2, 3]))


def test_sp_frame_lies_on_the_line_and_looks_at_the_sensor():
    line = make_line()
    frame = line.sp_frame
    np.testing.assert_allclose(polar_of_frame(frame), (line.alpha, line.rho), atol=1e-12)
    np.testing.assert_allclose(frame[:3, :3] @ frame[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame[:3, :3]) > 0
    first, last = line.endpoints
    assert first[0] * last[1] - first[1] * last[0] > 0
    assert frame[:2, 0] @ (last - first) > 0


def test_sp_covariance_is_that_of_the_perturbed_frame_which_is_at_the_middle_where_the_direction_is_certain():
    line, certain = make_line(), make_line(covariance=np.diag((0.0, 1e-4)))
    jacobian = central_differences(lambda p: polar_of_frame(line.sp_frame @ planar(0.0, *p)), np.zeros(2))
    np.testing.assert_allclose(jacobian @ line.sp_covariance @ jacobian.T, line.covariance, rtol=1e-6)
    np.testing.assert_allclose(certain.sp_frame[:2, 3], certain.endpoints.mean(axis=0), atol=1e-12)


@pytest.mark.parametrize("pose", [(0.5, -0.3, 0.4), (-5.0, -4.0, 0.4), (40.0, 9.0, -1.0)])
def test_transform_is_the_geometry_and_its_covariance_the_jacobian(pose):
    line = make_line()
    moved = line.transform(planar(*pose), np.diag((0.01, 0.02, 0.003)))

    def geometry(error):
        """(alpha, rho) from two moved points of the perturbed line."""
        normal = np.array((np.cos(line.alpha + error[0]), np.sin(line.alpha + error[0])))
        foot, along = (line.rho + error[1]) * normal, np.array((-normal[1], normal[0]))
        T = planar(*(np.array(pose) + error[2:]))
        a, b = (T[:2, :2] @ p + T[:2, 3] for p in (foot, foot + along))
        n = np.array(((b - a)[1], -(b - a)[0]))
        n *= np.sign(n @ a)
        return np.array((np.arctan2(n[1], n[0]), n @ a))

    np.testing.assert_allclose((moved.alpha, moved.rho), geometry(np.zeros(5)), atol=1e-12)
    jacobian = central_differences(geometry, np.zeros(5))
    full = np.zeros((5, 5))
    full[:2, :2], full[2:, 2:] = line.covariance, np.diag((0.01, 0.02, 0.003))
    np.testing.assert_allclose(moved.covariance, jacobian @ full @ jacobian.T, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(moved.endpoints @ moved.normal, moved.rho, atol=1e-12)


@pytest.mark.parametrize(
    ("first", "second", "error"),
    [
        ((0.7, 2.0), (0.72, 2.05), (0.02, 0.05)),
        ((np.pi - 0.01, 2.0), (-np.pi + 0.01, 2.0), (0.02, 0.0)),  # the short way round
        ((0.7, 0.01), (0.7 - np.pi, 0.01, COVARIANCE * ((1.0, -1.0), (-1.0, 1.0))), (0.0, 0.02)),  # through the sensor
    ],
)
def test_mahalanobis_is_chi2_of_the_difference(first, second, error):
    expected = error @ np.linalg.solve(2 * COVARIANCE, error)
    assert make_line(*first).mahalanobis(make_line(*second)) == pytest.approx(expected)
    assert make_line(*second).mahalanobis(make_line(*first)) == pytest.approx(expected)
