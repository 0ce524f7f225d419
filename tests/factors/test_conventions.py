"""The traps of the gtsam 4.3.0 wheel, pinned: where one of these fails, read the bridge again."""

import gtsam
import gtsam_unstable
import numpy as np
import pytest

from factors import landmark_to_plane, plane_factor, plane_landmark
from factors._conventions import (
    SP_TO_POSE3,
    error_to_sp,
    landmark_hesse,
    oriented_plane,
    square_root_informations,
    tangent_to_sp,
)
from factors._kernels import unit_basis
from tests.factors.factor_scenes import (
    TIED_NORMALS,
    A,
    L,
    X,
    perturbed,
    random_normals,
    random_plane,
    random_pose,
    values_of,
)

ISO = gtsam.noiseModel.Isotropic.Sigma(3, 0.1)


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


def test_local_factor_uses_the_measured_basis_and_the_stock_one_the_predicted():
    """A normal that crosses a tie: the stock error turns by 90 degrees, the local one does not."""
    measured = gtsam.OrientedPlane3(0.0, 0.0, 1.0, -1.0)
    errors = {"stock": [], "local": []}
    for tilt in ([0.01, 0.011, 1.0], [0.011, 0.01, 1.0]):
        values = values_of(x0=gtsam.Pose3(), a0=gtsam.Pose3(), l0=gtsam.OrientedPlane3(np.array([*tilt, -1.0])))
        stock = gtsam.OrientedPlane3Factor(measured.planeCoefficients(), ISO, X, L)
        errors["stock"].append(stock.unwhitenedError(values)[:2])
        local = gtsam_unstable.LocalOrientedPlane3Factor(measured, ISO, X, A, L)
        errors["local"].append(local.unwhitenedError(values)[:2])
    assert np.linalg.norm(errors["local"][0] - errors["local"][1]) < 0.002
    assert np.linalg.norm(errors["stock"][0] - errors["stock"][1]) > 0.01


def test_local_factor_error_is_predicted_minus_measured_distance():
    """The landmark 5.1 m away where 5.0 was measured: +0.1 in Hesse distance."""
    measured, true = oriented_plane(np.array([0.0, 0.0, -1.0]), 5.0), oriented_plane(np.array([0.0, 0.0, -1.0]), 5.1)
    values = values_of(x0=gtsam.Pose3(), a0=gtsam.Pose3(), l0=true)
    error = gtsam_unstable.LocalOrientedPlane3Factor(measured, ISO, X, A, L).unwhitenedError(values)
    np.testing.assert_allclose(error, [0.0, 0.0, 0.1], atol=1e-12)


def test_orientation_error_is_the_sine():
    """Blind from behind: the reversed plane has no orientation error at all."""
    for angle in (0.1, 1.0, 2.0, np.pi):
        seen = oriented_plane(np.array([np.sin(angle), 0.0, np.cos(angle)]), 0.0)
        values = values_of(x0=gtsam.Pose3(), a0=gtsam.Pose3(), l0=seen)
        measured = oriented_plane(np.array([0.0, 0.0, 1.0]), 0.0)
        error = gtsam_unstable.LocalOrientedPlane3Factor(measured, ISO, X, A, L).unwhitenedError(values)
        assert np.linalg.norm(error) == pytest.approx(abs(np.sin(angle)), abs=1e-12)


def test_a_pose_that_is_its_own_anchor_breaks_the_local_factor():
    """Its two blocks should cancel: the relative pose is the identity whatever the pose. The wheel counts one of them.

    This is why `plane_factor` makes a unary factor there.
    """
    plane = random_plane(np.random.default_rng(0))
    values = values_of(x0=gtsam.Pose3(), l0=plane_landmark(plane))
    prior = gtsam.PriorFactorPose3(X, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1.0))
    sigmas = {}
    for name, factor in (
        ("repeated key", gtsam_unstable.LocalOrientedPlane3Factor(plane_landmark(plane), ISO, X, X, L)),
        ("ours", plane_factor(plane, X, L, anchor_key=X)),
    ):
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(prior)
        graph.push_back(factor)
        sigmas[name] = np.sqrt(np.diag(gtsam.Marginals(graph, values).marginalCovariance(X)))
    np.testing.assert_allclose(sigmas["ours"], 1.0)
    assert sigmas["repeated key"].min() < 0.5


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


def test_landmark_and_back():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        plane = random_plane(rng)
        to_sp = tangent_to_sp(plane.frame)
        covariance = np.linalg.inv(to_sp) @ plane.covariance @ np.linalg.inv(to_sp).T
        back = landmark_to_plane(plane_landmark(plane), covariance, centre=plane.centre)
        np.testing.assert_allclose(back.normal, plane.normal, atol=1e-12)
        np.testing.assert_allclose(back.centre, plane.centre, atol=1e-9)
        turn = plane.frame[:3, :3].T @ back.frame[:3, :3]
        c, s = turn[0, 0], turn[1, 0]
        spin = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])  # theta' = c theta - s psi, psi' = s theta + c psi
        np.testing.assert_allclose(back.covariance, spin @ plane.covariance @ spin.T, atol=1e-12)


def test_plane_in_the_world():
    """A landmark put in the world from a pose predicts, from that pose, what was measured."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        plane, pose = random_plane(rng), random_pose(rng)
        values = values_of(x0=pose, l0=plane_landmark(plane, pose))
        assert plane_factor(plane, X, L).error(values) < 1e-15
        assert plane_factor(plane, X, L).error(values_of(x0=pose, l0=plane_landmark(plane, pose.matrix()))) < 1e-15
