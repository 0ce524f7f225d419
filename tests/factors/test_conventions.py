"""The traps of the gtsam 4.3.0 wheel, pinned: where one of these fails, read the bridge again."""

import gtsam
import numpy as np
import pytest

from factors import landmark_hesse, plane_factor, plane_landmark
from factors._conventions import SP_TO_POSE3, error_to_sp, oriented_plane, square_root_informations, tangent_to_sp
from factors._kernels import unit_basis
from tests.factors.factor_scenes import TIED_NORMALS, perturbed, random_normals, random_plane, random_pose, values_of


def test_oriented_plane_is_n_x_plus_d():
    """Moving 2 m along the normal of z = 5 leaves a plane 3 m ahead; in GTSAM's sign its D goes from -5 to -3."""
    plane = gtsam.OrientedPlane3(0.0, 0.0, 1.0, -5.0)
    moved = plane.transform(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 2.0])))
    np.testing.assert_allclose(moved.planeCoefficients(), [0.0, 0.0, 1.0, -3.0])
    normal, d = landmark_hesse(oriented_plane(np.array([0.0, 0.0, 1.0]), 5.0))
    np.testing.assert_allclose([*normal, d], [0.0, 0.0, 1.0, 5.0])


def test_error_vector_and_retract_have_opposite_distances():
    plane = gtsam.OrientedPlane3(0.1, 0.2, -0.9, 2.0)
    step = np.array([1e-3, 2e-3, 3e-3])
    np.testing.assert_allclose(plane.errorVector(plane.retract(step)), step * [1, 1, -1], atol=1e-8)
    np.testing.assert_allclose(plane.localCoordinates(plane.retract(step)), step, atol=1e-12)


def test_our_basis_is_gtsams_at_every_tie():
    for normal in np.vstack([TIED_NORMALS, random_normals(np.random.default_rng(0), 300)]):
        np.testing.assert_allclose(unit_basis(normal), gtsam.Unit3(normal).basis(), atol=1e-15)


def test_pose3_tangent_is_rotation_first():
    """The SP differential (x, y, z, phi about z, theta about y, psi about x) through the permutation."""
    differential = 1e-4 * np.arange(1.0, 7.0)
    x, y, z, phi, theta, psi = differential
    expected = gtsam.Pose3(gtsam.Rot3.RzRyRx(psi, theta, phi), np.array([x, y, z]))
    actual = gtsam.Pose3().retract(differential[SP_TO_POSE3])
    np.testing.assert_allclose(actual.matrix(), expected.matrix(), atol=1e-6)


def test_error_to_sp_and_tangent_to_sp_recover_the_perturbation():
    """Compose a plane with p, write it as error and as tangent, and read p back: to second order in p."""
    for seed in range(100):
        rng = np.random.default_rng(seed)
        plane = random_plane(rng, TIED_NORMALS[seed % 18] if seed < 50 else None)
        p = 1e-5 * rng.normal(size=3)
        moved = perturbed(plane.frame, p)
        landmark = plane_landmark(plane)
        true = oriented_plane(moved[:3, 2], moved[:3, 2] @ moved[:3, 3])
        error = landmark.errorVector(true)
        np.testing.assert_allclose(error_to_sp(plane.frame[None])[0] @ error, p, atol=1e-9)
        np.testing.assert_allclose(tangent_to_sp(plane.frame) @ landmark.localCoordinates(true), p, atol=1e-9)
        root = square_root_informations(plane.frame[None], plane.covariance[None])[0]
        np.testing.assert_allclose(np.tril(root, -1), 0.0)
        chi2 = p @ np.linalg.solve(plane.covariance, p)
        assert np.sum((root @ error) ** 2) == pytest.approx(chi2, rel=1e-3)


def test_plane_in_the_world():
    """A landmark put in the world from a pose predicts, from that pose, what was measured."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        plane, pose = random_plane(rng), random_pose(rng)
        factor = plane_factor(plane, gtsam.symbol("x", 0), gtsam.symbol("l", 0))
        for given in (pose, pose.matrix()):
            assert factor.error(values_of(x0=pose, l0=plane_landmark(plane, given))) < 1e-15
