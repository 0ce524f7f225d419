"""Shared pose errors at their limits: larger than what the points say, and far from where the scans turn."""

import numpy as np
import pytest

from spplanes import fit_plane


def wall(n, rng):
    return rng.uniform(-1, 1, (n, 3)) * (2, 1, 0) + (0, 0, 1) + rng.normal(0, 0.01, (n, 3))


@pytest.mark.parametrize(("n", "angle"), [(300, 0.005), (1000, 0.02), (3000, 0.1)])
def test_one_scans_pose_error_adds_to_the_covariance_of_its_points(n, angle):
    """A single scan tells nothing of its own pose: C = C_points + G S G^T, G = [t.z; rotations about y and x]."""
    rng = np.random.default_rng(n)
    points = wall(n, rng)
    pose = np.diag([0.01**2] * 3 + [angle**2] * 3)
    plain = fit_plane(points, sigma=0.01)
    shared = fit_plane(points, sigma=0.01, scan_index=np.zeros(n, int), pose_covariances=pose[None])
    x, y, z = plain.frame[:3, :3].T
    c = plain.centre
    axes = np.eye(3)[::-1]
    gain = np.zeros((3, 6))
    gain[0, :3], gain[0, 3:] = z, [z @ np.cross(axis, c) for axis in axes]
    gain[1, 3:], gain[2, 3:] = axes @ y, axes @ x
    np.testing.assert_allclose(shared.covariance, plain.covariance + gain @ pose @ gain.T, rtol=1e-3, atol=1e-9)


def test_world_side_pose_errors_1000_km_away():
    """The same errors written about the scan and, 1e6 m away, about the world's origin give the same plane."""
    rng = np.random.default_rng(5)
    points, scan = wall(400, rng), np.repeat(np.arange(4), 100)
    pose = np.tile(np.diag([0.01**2] * 3 + [0.005**2] * 3), (4, 1, 1))
    offset = np.array([1e6, 2e6, 0.0])
    about_world = np.eye(6)
    about_world[:3, 3:] = -np.column_stack([np.cross(axis, offset) for axis in np.eye(3)[::-1]])
    carried = about_world @ pose @ about_world.T
    carried = 0.5 * (carried + carried.transpose(0, 2, 1))
    shared = {"sigma": 0.01, "scan_index": scan}
    near = fit_plane(points, pose_covariances=pose, viewpoint=(0, 0, 5), **shared)
    far = fit_plane(points + offset, pose_covariances=carried, viewpoint=near.centre + offset + near.normal, **shared)
    np.testing.assert_allclose(far.normal, near.normal, atol=1e-7)
    assert far.normal @ (near.centre + offset) - far.d == pytest.approx(0.0, abs=1e-3)
    np.testing.assert_allclose(np.diag(far.covariance), np.diag(near.covariance), rtol=1e-3)


def test_pose_errors_that_leave_nothing():
    points, scan = wall(100, np.random.default_rng(6)), np.zeros(100, int)
    with pytest.raises(ValueError, match="points: expected scans whose pose covariances leave the plane of 100 points"):
        fit_plane(points, sigma=0.01, scan_index=scan, pose_covariances=np.eye(6)[None] * 1e30)
