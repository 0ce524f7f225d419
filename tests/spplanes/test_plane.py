import json
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from shapely import Polygon, box

from spplanes import Location, Moments, Plane
from spplanes._hesse import hesse_jacobian
from spplanes.spmodel import inverse_transform, transform_from_rpy
from tests.spplanes.fitting.fit_scenes import error_of
from tests.statistics import assert_jacobian, assert_mean_in_band, central_differences, nees


def random_plane(seed, *, scale=1e-2, spread=5.0):
    rng = np.random.default_rng(seed)
    root = scale * rng.normal(size=(3, 3))
    frame = transform_from_rpy(rng.uniform(-1, 1, 6) * [spread, spread, spread, np.pi, 1.5, np.pi])
    return Plane(frame, root @ root.T, 10)


def perturbed(plane, p):
    return Plane._trusted(plane.frame @ transform_from_rpy((0, 0, p[0], 0, p[1], p[2])), plane.covariance, 0)


def hesse(plane):
    return np.append(plane.normal, plane.d)


def turned_in_itself(plane, angle, shift):
    """The same plane and the same uncertainty, written in another frame of it."""
    t = transform_from_rpy((*shift, 0.0, angle, 0.0, 0.0))
    location = plane.location.compose(Location.plane(t, np.zeros((3, 3))))
    return Plane(location.transform, location.covariance)


def test_hesse_form_both_ways_and_its_jacobian_against_central_differences():
    for seed in range(20):
        plane = random_plane(seed)
        assert_jacobian(lambda p, plane=plane: hesse(perturbed(plane, p)), np.zeros(3), hesse_jacobian(plane.frame))
        covariance = plane.hesse_covariance
        assert np.linalg.matrix_rank(covariance, tol=1e-9 * np.abs(covariance).max()) == 3
        back = Plane.from_hesse(plane.normal, plane.d, covariance, centre=plane.centre)
        np.testing.assert_allclose(hesse(back), hesse(plane), atol=1e-12)
        np.testing.assert_allclose(back.centre, plane.centre, atol=1e-12)
        np.testing.assert_allclose(back.hesse_covariance, covariance, atol=1e-12)


def test_hesse_form_known_answer():
    """A wall x = 5 centred at (5, 2, 0): turning it by theta about its y axis, the world's z, moves d by 2 theta."""
    frame = np.array([[0.0, 0, 1, 5], [1, 0, 0, 2], [0, 1, 0, 0], [0, 0, 0, 1]])
    plane = Plane(frame, np.diag([0.01, 0.02, 0.03]))
    expected = np.zeros((4, 4))
    # dn = theta e_y - psi e_z, dd = z + 2 theta.
    expected[1, 1], expected[2, 2], expected[3, 3] = 0.02, 0.03, 0.01 + 4 * 0.02
    expected[1, 3] = expected[3, 1] = 2 * 0.02
    np.testing.assert_allclose(plane.hesse_covariance, expected, atol=1e-15)
    assert plane.d == 5.0


def test_transform_propagates_as_central_differences_do():
    rng = np.random.default_rng(1)
    for seed in range(20):
        plane = random_plane(seed)
        root = rng.normal(size=(6, 6))
        t, pose_cov = transform_from_rpy(rng.normal(size=6)), root @ root.T
        moved = plane.transform(t, pose_cov)

        def difference(p, plane=plane, t=t, moved=moved):
            frame = t @ transform_from_rpy(p[3:]) @ perturbed(plane, p[:3]).frame
            return Location.plane(moved.frame, np.eye(3)).perturbation_to(frame)

        j = central_differences(difference, np.zeros(9))
        expected = j[:, :3] @ plane.covariance @ j[:, :3].T + j[:, 3:] @ pose_cov @ j[:, 3:].T
        np.testing.assert_allclose(moved.covariance, expected, rtol=1e-6, atol=1e-7)
        np.testing.assert_allclose(plane.transform(t).covariance, plane.covariance)
        np.testing.assert_allclose(plane.transform(t).transform(inverse_transform(t)).frame, plane.frame, atol=1e-12)


def test_mahalanobis_is_chi2_with_3_dof_whatever_the_frames():
    """Two estimates of one plane, in frames 3 m apart and turned at random: NEES of their difference, 2000 pairs."""
    rng, values = np.random.default_rng(2), []
    for seed in range(2000):
        true = random_plane(seed, scale=1e-4)
        other = turned_in_itself(random_plane(seed, scale=1e-4), rng.uniform(-3, 3), rng.uniform(-3, 3, 2))
        a = perturbed(true, np.linalg.cholesky(true.covariance) @ rng.normal(size=3))
        b = perturbed(other, np.linalg.cholesky(other.covariance) @ rng.normal(size=3))
        b = turned_in_itself(b, rng.uniform(-3, 3), rng.uniform(-3, 3, 2))
        values.append(a.mahalanobis(b))
    assert_mean_in_band(np.array(values), 3)


def test_mahalanobis_by_hand_and_at_its_ends():
    a = Plane(np.eye(4), np.diag([1e-4, 1e-6, 1e-6]))
    # Shift by 0.02 m, summed variance 2e-4: 4e-4 / 2e-4 = 2.
    assert a.mahalanobis(perturbed(a, (0.02, 0, 0))) == pytest.approx(2.0)
    assert a.mahalanobis(a) == 0.0
    assert a.mahalanobis(Plane(transform_from_rpy((0, 0, 0, 0, np.pi, 0)), a.covariance)) == np.inf
    exact = Plane(np.eye(4), np.zeros((3, 3)))
    assert exact.mahalanobis(exact) == 0.0
    assert exact.mahalanobis(perturbed(exact, (0.01, 0, 0))) == np.inf
    far = Plane(transform_from_rpy((1e6, 1e6, 1e6, 0, 0, 0)), a.covariance)
    assert far.mahalanobis(perturbed(far, (0.02, 0, 0))) == pytest.approx(2.0, rel=1e-6)


def noisy_moments(seed, n, shift):
    rng = np.random.default_rng(seed)
    local = np.column_stack([rng.uniform(-2, 2, n) + shift, rng.uniform(-1, 1, n), 0.01 * rng.normal(size=n)])
    t = transform_from_rpy((10.0, -20.0, 5.0, 0.5, 0.4, 2.0))
    return Moments.from_points(local @ t[:3, :3].T + t[:3, 3], np.full(n, 1e4))


@pytest.mark.parametrize("seed", range(10))
def test_merge_is_the_fit_of_the_merged_moments(seed):
    a, b = noisy_moments(seed, 40, 0.0), noisy_moments(seed + 100, 70, 3.0)
    merged, refit = a.plane().merge(b.plane()), (a + b).plane()
    np.testing.assert_allclose(merged.frame, refit.frame, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(merged.covariance, refit.covariance, rtol=1e-9, atol=1e-9 * refit.covariance.max())
    assert merged.n_points == refit.n_points == 110
    assert merged.chi2 == pytest.approx(refit.chi2, rel=1e-9)


def test_merge_fuses_correlated_planes_as_information_does():
    """Planes that are no fits: the merged error is what weighting by information gives, and NEES is in its band."""
    rng, errors, covariances = np.random.default_rng(3), [], []
    root_a, root_b = 1e-4 * rng.normal(size=(3, 3)), 1e-4 * rng.normal(size=(3, 3))
    true = random_plane(1)
    shift = transform_from_rpy((2.0, 1.0, 0.0, 0.7, 0.0, 0.0))
    for _ in range(2000):
        a = Plane(true.frame, root_a @ root_a.T, 5)
        b = Plane(true.frame @ shift, root_b @ root_b.T, 7)
        merged = perturbed(a, root_a @ rng.normal(size=3)).merge(perturbed(b, root_b @ rng.normal(size=3)))
        errors.append(error_of(merged.frame, true.frame))
        covariances.append(merged.covariance)
    assert_mean_in_band(nees(np.array(errors), np.array(covariances)), 3)


def test_distance_and_projection():
    plane = Plane.from_hesse((0.0, 0.6, 0.8), 2.0, np.eye(3))
    points = np.array([[1.0, 0.6 * 5, 0.8 * 5], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(plane.distance(points), [3.0, -2.0])
    np.testing.assert_allclose(plane.project(points), [[1.0, 1.2, 1.6], [0.0, 1.2, 1.6]], atol=1e-15)
    np.testing.assert_allclose(plane.distance(plane.project(points)), 0.0, atol=1e-15)
    assert plane.distance(points[0]) == pytest.approx(3.0)
    assert plane.project(points[0]).shape == (3,)


def outlined():
    outline = Polygon([(0, 0), (2, 0), (2, np.pi / 3), (0, 1)], [[(0.1, 0.1), (0.3, 0.1), (0.3, 1 / 3)]])
    return replace(random_plane(4), n_points=17, outline=outline, chi2=14.2)


def test_dict_round_trip_is_exact_through_json():
    for plane in (outlined(), random_plane(5)):
        back = Plane.from_dict(json.loads(json.dumps(plane.to_dict())))
        assert back == plane and back.to_dict() == plane.to_dict()
        assert {"normal", "d", "frame", "covariance", "n_points", "outline"} <= set(plane.to_dict())
    assert Plane.from_dict(replace(outlined(), outline=Polygon()).to_dict()).outline is None
    back = Plane.from_dict({**outlined().to_dict(), "id": 3, "observations": 5})
    assert back.outline.equals_exact(outlined().outline, 0.0)
    assert len(back.outline.interiors) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frame": [[1, 2], [3, 4]]}, r"frame: expected shape \(4, 4\), got \(2, 2\)"),
        ({"frame": "wall"}, "frame: expected an array of numbers, got str"),
        ({"covariance": (-np.eye(3)).tolist()}, "covariance: expected a positive semidefinite covariance"),
        ({"covariance": None}, "covariance: expected"),
        ({"normal": [0.0, 0.0, 1.0]}, "normal: expected the frame's z axis"),
        ({"d": 1e3}, "d: expected the frame's distance"),
        ({"d": None}, "d: expected"),
        ({"chi2": "much"}, "chi2: expected"),
        ({"outline": 5}, "outline: expected a list of rings, got int"),
        ({"outline": [[[0, 0], [1, 0]]]}, "outline: expected closed rings of at least 4 points"),
        ({"outline": [[[0, 0], [1, 1], [1, 0], [0, 1], [0, 0]]]}, "outline: expected a valid polygon"),
        ({"outline": [[[0, 0, 0], [1, 1, 0]]]}, r"outline: expected shape \(N, 2\), got \(2, 3\)"),
    ],
)
def test_malformed_dict(change, message):
    with pytest.raises(ValueError, match=message):
        Plane.from_dict({**outlined().to_dict(), **change})


def test_mahalanobis_is_symmetric_for_planes_apart_and_tilted():
    """Only a z axis midway between both normals makes it so; where the frame's origin is does not matter."""
    rng = np.random.default_rng(11)
    for _ in range(20):
        root = rng.normal(size=(3, 3))
        turn = Location.pose(np.eye(4), np.eye(6)).perturbed([*rng.uniform(-5, 5, 3), *rng.normal(0, 0.2, 3)])
        a = Plane(np.eye(4), np.diag([1e-4, 1e-2, 1e-3]))
        b = Plane(turn.transform, 1e-3 * root @ root.T)
        assert a.mahalanobis(b) == pytest.approx(b.mahalanobis(a), rel=1e-9)


def test_a_plane_is_a_value():
    """Equal to the bit is equal, whatever made it; what it holds cannot be written to, after a copy either."""
    frame, covariance = np.eye(4), np.diag([1e-4, 1e-5, 1e-5])
    plane = Plane(frame, covariance, 40, box(-1, -1, 1, 1))
    same = deepcopy(plane)
    assert plane == same and hash(plane) == hash(same) and len({plane, same}) == 1
    assert plane == Plane.from_dict(plane.to_dict()) and plane in [Plane(frame, 2.0 * covariance, 40), same]
    shifted = transform_from_rpy((1e-15, 0, 0, 0, 0, 0))
    for other in (Plane(frame, covariance, 41), Plane(frame, covariance, 40), plane.transform(shifted), "a plane"):
        assert plane != other
    for one in (plane, same, plane.transform(np.eye(4)), plane.merge(same)):
        for array in (one.frame, one.covariance, one.normal, one.centre):
            with pytest.raises(ValueError, match="read-only"):
                array[0] = 7.0
    frame[0, 3] = covariance[0, 0] = 7.0  # the caller's own arrays stay the caller's
    assert plane == same
