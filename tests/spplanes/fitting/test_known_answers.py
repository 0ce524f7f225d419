"""Answers that can be had by hand, or by differentiating numerically; the outline on request."""

import numpy as np
import pytest
import shapely

from spplanes import Location, fit_plane, fit_planes
from spplanes.spmodel import transform_from_rpy
from tests.spplanes.fitting.fit_scenes import laser_covariances
from tests.statistics import central_differences

CORNERS = np.array([[2.0, 1, 0], [2, -1, 0], [-2, 1, 0], [-2, -1, 0]])


def laser_patch(seed, n, *, sigma_range=0.02):
    """A noisy oblique patch and its covariances."""
    rng = np.random.default_rng(seed)
    t = transform_from_rpy((4.0, 1.0, 0.5, 0.3, 0.9, 0.2))
    local = np.column_stack([rng.uniform(-1.5, 1.5, n), rng.uniform(-0.7, 0.7, n), np.zeros(n)])
    points = local @ t[:3, :3].T + t[:3, 3]
    covariances = laser_covariances(points, sigma_range, 0.002)
    roots = np.linalg.cholesky(covariances)
    return points + np.einsum("nij,nj->ni", roots, rng.normal(size=points.shape)), covariances


@pytest.mark.parametrize("method", ["ml", "sp"])
def test_four_corners(method):
    """(+-2, +-1, 0), sigma s: z is a mean of 4; the slopes along x, y have sum x^2 = 16, sum y^2 = 4.

    Noise along the plane adds 3 s^2 to the curvature's sum (n - 1 = 3), below the digits compared for s = 10 um.
    """
    s = 1e-5
    plane = fit_plane(np.add(CORNERS, (0, 0, 5.0)), sigma=s, method=method)
    np.testing.assert_allclose(plane.frame, transform_from_rpy((0, 0, 5, 0, 0, 0)), atol=1e-15)
    np.testing.assert_allclose(plane.covariance, s**2 * np.diag([1 / 4, 1 / 16, 1 / 4]), rtol=1e-8, atol=1e-20)
    assert (plane.d, plane.n_points) == (5.0, 4)
    assert plane.chi2 == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("method", ["ml", "sp"])
def test_saddle(method):
    """Corners at heights +h, -h, -h, +h: by symmetry the plane stays z = 0, and chi2 is 4 h^2 / s^2."""
    points = CORNERS + np.array([1, -1, -1, 1])[:, None] * (0, 0, 0.01) - (0, 0, 3.0)
    plane = fit_plane(points, sigma=0.02, method=method)
    np.testing.assert_allclose(plane.normal, [0, 0, -1], atol=1e-12)
    assert plane.d == pytest.approx(3.0)
    assert plane.chi2 == pytest.approx(4 * 0.01**2 / 0.02**2)


def test_weighted_heights():
    """Four corners at z = 0 with sigma 1 mm, the same four at z = 5 mm with 2 mm; 2 km wide, so tilts stay out.

    ml: weights 1 and 1/4, z = 1 mm, variance 1 / (4 + 1) mm^2.
    sp: weights 1 / trace^2 ~ 1 and 1/16, z = 5/17 mm, variance (4 + 4 * 4 / 256) / (4 * 17 / 16)^2 mm^2.
    """
    points = np.concatenate([1000 * CORNERS, 1000 * CORNERS + (0, 0, 0.005)])
    covariances = np.repeat([1e-6, 4e-6], 4)[:, None, None] * np.eye(3)
    ml = fit_plane(points, covariances, viewpoint=(0, 0, 1), shared_error=False)
    sp = fit_plane(points, covariances, viewpoint=(0, 0, 1), method="sp")
    assert ml.d == pytest.approx(0.001, rel=1e-9)
    assert ml.covariance[0, 0] == pytest.approx(1e-6 / 5, rel=1e-9)
    assert sp.d == pytest.approx(0.005 / 17, rel=1e-9)
    assert sp.covariance[0, 0] == pytest.approx(1e-6 * (4 + 16 / 256) / (4 * 17 / 16) ** 2, rel=1e-9)
    # ml: four points at z = 0 miss by 1 mm of 1 mm, four by 4 mm of 2 mm.
    assert ml.chi2 == pytest.approx(4 * 1 + 4 * 4)


@pytest.mark.parametrize("method", ["ml", "sp"])
def test_three_points_are_met_and_have_a_triangle(method):
    plane = fit_plane(np.eye(3), sigma=0.01, method=method, outline=True)
    np.testing.assert_allclose(plane.normal, np.full(3, 3**-0.5), atol=1e-14)
    assert plane.d == pytest.approx(3**-0.5)
    assert plane.chi2 == pytest.approx(0.0, abs=1e-20)
    assert plane.outline.area == pytest.approx(0.5 * 3**0.5)


def test_shared_pose_known_answer():
    """One scan of four corners, its pose sure but for a lift of variance a along z: that adds to z, and only there.

    A second scan with no pose error at the same corners: information adds up, 1/(s^2/4 + a) + 4/s^2.
    """
    s, a = 1e-3, 4e-6
    poses = np.zeros((2, 6, 6))
    poses[0, 2, 2] = a
    points = np.add(np.concatenate([CORNERS, CORNERS]), (0, 0, 2.0))
    index = np.repeat([0, 1], 4)
    one = fit_plane(points[:4], sigma=s, scan_index=index[:4], pose_covariances=poses)
    assert one.covariance[0, 0] == pytest.approx(s**2 / 4 + a, rel=1e-9)
    assert one.covariance[1, 1] == pytest.approx(s**2 / 16, rel=1e-5)
    both = fit_plane(points, sigma=s, scan_index=index, pose_covariances=poses)
    assert both.covariance[0, 0] == pytest.approx(1 / (1 / (s**2 / 4 + a) + 4 / s**2), rel=1e-9)
    paper = fit_plane(points, sigma=s, method="sp", scan_index=index, pose_covariances=poses)
    assert paper.covariance[0, 0] == pytest.approx(s**2 / 8 + a / 4, rel=1e-9)


@pytest.mark.parametrize("method", ["ml", "sp"])
@pytest.mark.parametrize("axis", range(6))
def test_pose_perturbation_moves_the_plane_as_told(method, axis):
    """One scan with one uncertain pose component: the covariance it adds is that of moving the points by it."""
    points, covariances = laser_patch(1, 50)
    sigma, origin = 1e-3, np.array([1.0, -2.0, 0.5])
    pose = np.zeros((1, 6, 6))
    pose[0, axis, axis] = sigma**2
    shared = {"scan_index": np.zeros(50, int), "pose_covariances": pose, "scan_origins": [origin]}
    plain = fit_plane(points, covariances, method=method)
    with_pose = fit_plane(points, covariances, method=method, **shared)
    direction = np.eye(3)[axis] if axis < 3 else np.cross(np.eye(3)[5 - axis], points - origin)
    location = Location.plane(plain.frame, np.eye(3))

    def moved(step):
        # The noise turns with the scan; for ml its orientation matters to first order.
        turn = np.eye(3) if axis < 3 else np.eye(3) + step * np.cross(np.eye(3), np.eye(3)[5 - axis]).T
        cloud, eye = points + step * direction, plain.centre + plain.normal
        there = fit_plane(cloud, turn @ covariances @ turn.T, method=method, viewpoint=eye)
        return location.perturbation_to(there.frame)

    g = (moved(1e-5) - moved(-1e-5)) / 2e-5
    added = with_pose.covariance - plain.covariance
    np.testing.assert_allclose(added, sigma**2 * np.outer(g, g), rtol=2e-2, atol=1e-2 * np.abs(added).max())


def test_sp_covariance_is_the_derivative_of_the_whole_pipeline():
    """F by central differences of fit_plane by every coordinate of every point; C = F diag(C_i) F^T to 1e-6."""
    points, covariances = laser_patch(2, 9, sigma_range=0.1)
    plane = fit_plane(points, covariances, method="sp")
    location = Location.plane(plane.frame, np.eye(3))

    def pipeline(flat):
        there = fit_plane(flat.reshape(-1, 3), covariances, method="sp", viewpoint=plane.centre + plane.normal)
        return location.perturbation_to(there.frame)

    f = central_differences(pipeline, points.ravel())
    expected = np.einsum("inj,njk,lnk->il", f.reshape(3, 9, 3), covariances, f.reshape(3, 9, 3))
    np.testing.assert_allclose(plane.covariance, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_ml_is_at_the_minimum_and_its_covariance_is_the_inverse_curvature():
    points, covariances = laser_patch(3, 400, sigma_range=0.005)
    plane = fit_plane(points, covariances)
    sigma = np.sqrt(np.diag(plane.covariance))
    e = np.diag(0.1 * sigma)

    def cost(p):
        frame = plane.frame @ transform_from_rpy((0, 0, p[0], 0, p[1], p[2]))
        n = frame[:3, 2]
        return np.sum(((points - frame[:3, 3]) @ n) ** 2 / np.einsum("i,nij,j->n", n, covariances, n))

    gradient = np.array([(cost(k) - cost(-k)) / 0.2 for k in e])  # by sigmas; half its square is what is left to gain
    assert np.abs(gradient).max() < 1e-3
    hessian = np.array([[cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b) for a in e] for b in e]) / 0.04
    expected = np.linalg.inv(plane.covariance / np.outer(sigma, sigma))
    np.testing.assert_allclose(0.5 * hessian, expected, atol=0.05)


@pytest.mark.parametrize("options", [{}, {"method": "sp"}, {"robust": "tukey"}])
def test_rigid_motion_moves_the_plane_and_nothing_else(options):
    points, covariances = laser_patch(4, 80)
    t = transform_from_rpy((100.0, -50.0, 20.0, 2.0, 0.7, -1.0))
    here = fit_plane(points, covariances, viewpoint=np.zeros(3), **options)
    rotated = t[:3, :3] @ covariances @ t[:3, :3].T
    there = fit_plane(points @ t[:3, :3].T + t[:3, 3], rotated, viewpoint=t[:3, 3], **options)
    expected = here.transform(t)
    sign = np.sign(there.frame[:3, 0] @ expected.frame[:3, 0])
    np.testing.assert_allclose(there.frame, expected.frame @ np.diag([sign, sign, 1.0, 1.0]), atol=1e-9)
    turn = np.diag([1.0, sign, sign])
    scale = np.sqrt(np.outer(*[np.diag(there.covariance)] * 2))
    np.testing.assert_allclose(there.covariance / scale, turn @ expected.covariance @ turn / scale, atol=1e-6)
    assert there.chi2 == pytest.approx(here.chi2, rel=1e-6)


def test_normal_faces_the_viewpoint_or_d_is_not_negative():
    points, covariances = laser_patch(6, 50)
    toward = fit_plane(points, covariances, viewpoint=(0.0, 0.0, 0.0))
    away = fit_plane(points, covariances, viewpoint=2 * points.mean(axis=0))
    assert toward.normal @ toward.centre < 0.0 < away.normal @ away.centre
    assert fit_plane(points, covariances).d > 0.0
    for plane in (toward, away):
        assert np.linalg.det(plane.frame[:3, :3]) == pytest.approx(1.0)
    # Seen from behind, z and theta change sign: the frame is turned about its x axis.
    flip = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(away.covariance, flip @ toward.covariance @ flip, rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize(("options", "poses"), [({}, 0), ({"method": "sp"}, 0), ({"robust": "tukey"}, 0), ({}, 4)])
@pytest.mark.parametrize("stretch", [1, 10**9])
def test_fit_planes_is_fit_plane_of_each_label(options, poses, stretch):
    rng = np.random.default_rng(9)
    clouds = [laser_patch(seed, int(rng.integers(20, 60))) for seed in range(12)]
    points, covariances = (np.concatenate([cloud[k] for cloud in clouds]) for k in (0, 1))
    labels = stretch * np.repeat(np.arange(12) // 5 * 5 + np.arange(12) % 5 * 2 - 4, [len(p) for p, _ in clouds])
    order = rng.permutation(len(points))
    points, covariances, labels = points[order], covariances[order], labels[order]
    shared = {}
    if poses:
        root = 1e-2 * rng.normal(size=(poses, 6, 6))
        shared = {"scan_index": rng.integers(0, poses, len(points)), "pose_covariances": root @ root.transpose(0, 2, 1)}
    planes = fit_planes(points, covariances, labels, **options, **shared)
    names = np.unique(labels[labels >= 0])
    assert len(planes) == len(names)
    for name, plane in zip(names, planes, strict=True):
        own = labels == name
        mine = dict(shared, scan_index=shared["scan_index"][own]) if shared else {}
        alone = fit_plane(points[own], covariances[own], **options, **mine)
        np.testing.assert_allclose(plane.frame, alone.frame, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(plane.covariance, alone.covariance, rtol=1e-9, atol=1e-18)
        assert (plane.n_points, plane.chi2) == (alone.n_points, pytest.approx(alone.chi2))


def patch(rng: np.random.Generator, n: int = 400) -> np.ndarray:
    return np.column_stack([rng.uniform(-1.0, 1.0, n), rng.uniform(-2.0, 2.0, n), 0.01 * rng.normal(size=n)])


def test_the_hull_holds_every_point_that_is_not_left_out_and_nothing_else_changes():
    points, rng = patch(np.random.default_rng(0)), np.random.default_rng(1)
    plain, outlined = fit_plane(points, sigma=0.01), fit_plane(points, sigma=0.01, outline=True)
    assert plain.outline is None
    np.testing.assert_array_equal(plain.covariance, outlined.covariance)
    flat = (points - outlined.centre) @ outlined.frame[:3, :2]
    assert outlined.outline.buffer(1e-9).covers(shapely.multipoints(flat))
    assert outlined.outline.area == pytest.approx(8.0, rel=0.08)
    points = patch(rng)
    points[:40] = rng.uniform(-9.0, 9.0, (40, 3)) + np.array([0.0, 0.0, 12.0])
    assert fit_plane(points, sigma=0.01, robust="tukey", outline=True).outline.area < 8.0
