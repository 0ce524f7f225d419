"""Maps as Open3D geometry: shapes, sides, holes, deviations; legacy and tensor alike; without a window."""

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest
from shapely import LineString, MultiPolygon, Polygon, box

from factors import plane_factor, plane_landmark, pose_prior, world_plane
from slam.io.clouds import Cloud
from slam.io.trajectories import Trajectory
from slam.planeslam import MapPlane
from slam.visualization.open3d_export import (
    ellipsoids_to_lines,
    outlines_to_lines,
    planes_to_mesh,
    points_to_cloud,
    trajectory_to_lines,
)
from spplanes import Plane, fit_plane
from spplanes.spmodel import transform_from_rpy

try:
    import open3d as o3d
except (ImportError, OSError) as error:  # OSError: a system library that it loads is not there
    o3d, REASON = None, f"open3d cannot be imported: {error}"
else:
    REASON = ""

needs_open3d = pytestmark = pytest.mark.skipif(o3d is None, reason=REASON)

FRAME = transform_from_rpy((1.0, 2.0, 3.0, 0.4, -0.7, 0.2))
COVARIANCE = np.diag([1e-6, 4e-6, 9e-6])
WINDOW = Polygon([(-2, -1), (2, -1), (2, 1), (-2, 1)], [[(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]])


def wall(number=7, seen=WINDOW, frame=FRAME):
    polygon = seen if isinstance(seen, Polygon) else None
    return MapPlane(number, Plane(frame, COVARIANCE, 100, polygon), seen, 3, ("plane",))


def two_planes():
    floor = transform_from_rpy((0.0, 0.0, 0.0, 0.3, 0.0, 0.0))
    return [wall(), wall(9, MultiPolygon([box(0, 0, 1, 1), box(2, 0, 4, 1)]), floor)]


def moving(count: int, y: float = 0.0) -> Trajectory:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = np.linspace(-2.0, 2.0, count), y
    return Trajectory(np.arange(count), poses)


def test_mesh_has_the_area_of_the_outlines_less_their_holes_lies_on_its_plane_and_faces_its_side():
    assert planes_to_mesh(two_planes()).get_surface_area() == pytest.approx((8.0 - 1.0) + (1.0 + 2.0), rel=1e-12)
    plane, mesh = wall().plane, planes_to_mesh([wall()])
    assert np.abs(plane.distance(np.asarray(mesh.vertices))).max() < 1e-12
    mesh.compute_triangle_normals()
    for normals in (mesh.vertex_normals, mesh.triangle_normals):
        np.testing.assert_allclose(normals, np.tile(plane.normal, (len(normals), 1)), atol=1e-12)


def test_colour_by_deviation_grows_from_dark_to_bright():
    mesh = planes_to_mesh([wall()], colour_by="sigma")
    sigmas = np.linalg.norm(np.asarray(mesh.vertices) - FRAME[:3, 3], axis=1)  # inner corners are the surer ones
    brightness = np.asarray(mesh.vertex_colors).sum(axis=1)
    inner = sigmas < 1.0
    assert brightness[inner].max() < brightness[~inner].min()
    limited = planes_to_mesh([wall()], colour_by="sigma", sigma_limit_m=1e-6)
    assert len(np.unique(np.asarray(limited.vertex_colors), axis=0)) == 1


def test_outlines_are_closed_rings_and_lone_segments():
    planes = [wall(), wall(8, LineString([(0, 0), (3, 0)]))]
    lines = outlines_to_lines(planes)
    points, pairs = np.asarray(lines.points), np.asarray(lines.lines)
    lengths = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    assert len(pairs) == 4 + 4 + 1
    assert lengths.sum() == pytest.approx(12.0 + 4.0 + 3.0, rel=1e-12)
    assert len(lines.colors) == len(pairs)


def test_tensor_geometry_is_the_legacy_one_with_ids_and_deviations():
    planes = two_planes()
    legacy, tensor = planes_to_mesh(planes), planes_to_mesh(planes, tensor=True)
    np.testing.assert_array_equal(tensor.vertex.positions.numpy(), np.asarray(legacy.vertices))
    np.testing.assert_array_equal(tensor.triangle.indices.numpy(), np.asarray(legacy.triangles))
    np.testing.assert_allclose(tensor.vertex.colors.numpy(), np.asarray(legacy.vertex_colors), atol=1e-6)
    assert set(tensor.vertex["plane"].numpy().ravel()) == {7, 9}
    assert tensor.vertex["sigma_m"].numpy().min() >= 1e-3
    np.testing.assert_allclose(np.asarray(tensor.to_legacy().vertices), np.asarray(legacy.vertices), atol=1e-6)
    lines = outlines_to_lines(planes, tensor=True)
    np.testing.assert_array_equal(lines.line.indices.numpy(), np.asarray(outlines_to_lines(planes).lines))
    assert list(lines.line["plane"].numpy().ravel()) == [7] * 8 + [9] * 8
    assert trajectory_to_lines(moving(3), tensor=True).line.indices.numpy().shape == (2, 2)


def test_points_are_coloured_by_plane_and_gaps_are_left_out():
    points = np.arange(24.0).reshape(2, 4, 3)
    points[0, 1] = np.nan
    labels = np.array([[0, 0, 1, -1], [0, 1, 1, 2]], dtype=np.int32)
    cloud = points_to_cloud(points, labels)
    colours = np.asarray(cloud.colors)
    assert len(cloud.points) == 7
    assert len(np.unique(colours, axis=0)) == 4 and (colours[0] == colours[3]).all()
    tensor = points_to_cloud(points, labels, tensor=True)
    np.testing.assert_array_equal(tensor.point["plane"].numpy().ravel(), [0, 1, -1, 0, 1, 1, 2])
    assert len(points_to_cloud(points).points) == 7


def test_a_fitted_plane_without_an_outline_is_the_rectangle_of_its_points():
    """The extents come out of the covariance: of 20,000 points spread evenly they are right to 2 %."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (20_000, 3)) * [1.5, 0.4, 0.0] + rng.normal(size=(20_000, 1)) * [0.0, 0.0, 0.01]
    mesh = planes_to_mesh([fit_plane(points, sigma=0.01)])
    corners = np.abs(np.asarray(mesh.vertices))
    np.testing.assert_allclose(corners[:, :2].max(axis=0), [1.5, 0.4], rtol=0.02)
    assert mesh.get_surface_area() == pytest.approx(3.0 * 0.8, rel=0.03)


def test_planes_of_a_graph_of_ones_own_are_drawn():
    rng = np.random.default_rng(1)
    world_T_body = gtsam.Pose3(gtsam.Rot3.Yaw(0.4), np.array([3.0, 1.0, 0.0]))
    points = rng.uniform(-1.0, 1.0, (500, 3)) * [1.5, 0.4, 0.0] + [0.0, 0.0, 2.0]
    seen = fit_plane(points + rng.normal(size=points.shape) * 0.01, sigma=0.01, outline=True)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.push_back(pose_prior(1, world_T_body, 1e-6 * np.eye(6)))
    graph.push_back(plane_factor(seen, 1, 2, anchor_key=1))
    values.insert(1, world_T_body)
    values.insert(2, plane_landmark(seen))
    marginals = gtsam.Marginals(graph, values)
    there = seen.transform(world_T_body)
    plane = world_plane(values, marginals, 2, anchor_key=1, shape_of=there)
    assert planes_to_mesh([plane]).get_surface_area() == pytest.approx(seen.outline.area, rel=1e-9)
    np.testing.assert_allclose(plane.frame, there.frame, atol=1e-9)
    loose = world_plane(values, marginals, 2, anchor_key=1, centre=plane.centre)
    assert loose.mahalanobis(plane) == pytest.approx(0.0, abs=1e-6)
    assert np.linalg.det(loose.covariance) == pytest.approx(np.linalg.det(plane.covariance), rel=1e-6)
    with pytest.raises(ValueError, match="shape_of: expected a plane with an outline, got one without"):
        world_plane(values, marginals, 2, anchor_key=1, shape_of=loose)


def test_trajectories_of_any_kind_are_lines():
    """A run's, poses, positions."""
    poses, expected = moving(3).poses, trajectory_to_lines(moving(3))
    run, transforms = SimpleNamespace(trajectory=moving(3)), [gtsam.Pose3(pose) for pose in poses]
    for given in (run, poses, list(poses), transforms, poses[:, :3, 3]):
        lines = trajectory_to_lines(given)
        np.testing.assert_array_equal(np.asarray(lines.points), np.asarray(expected.points))
        assert len(lines.lines) == 2
    assert len(trajectory_to_lines([]).points) == 0


def test_ellipsoids_enclose_what_the_covariance_says():
    """Every corner at the chi2 quantile of its ellipsoid, enlarged as told; the great ellipses reach all six poles."""
    rng = np.random.default_rng(0)
    root = rng.standard_normal((3, 3)) * [0.1, 0.02, 0.3]
    covariance, centre = root @ root.T, np.array([1.0, -2.0, 3.0])
    lines = ellipsoids_to_lines([centre, -centre], [covariance, 4.0 * covariance], confidence=0.9, scale=10.0)
    points = np.asarray(lines.points)
    first = (points[: len(points) // 2] - centre) / 10.0
    chi2 = np.einsum("ni,ij,nj->n", first, np.linalg.inv(covariance), first)
    np.testing.assert_allclose(chi2, 6.251, atol=1e-3)  # 90 % quantile, 3 degrees of freedom
    second = (points[len(points) // 2 :] + centre) / 10.0
    np.testing.assert_allclose(second, 2.0 * first, atol=1e-9)
    values, vectors = np.linalg.eigh(covariance)
    for value, axis in zip(values, vectors.T, strict=True):
        pole = np.sqrt(6.251 * value) * axis
        for end in (pole, -pole):
            assert np.linalg.norm(first - end, axis=1).min() < 1e-3 * np.sqrt(values[2])
    tensor = ellipsoids_to_lines([centre], [covariance], tensor=True)
    assert set(tensor.line["plane"].numpy().ravel()) == {0}
    assert not ellipsoids_to_lines(np.empty((0, 3)), np.empty((0, 3, 3))).has_lines()
    flat = ellipsoids_to_lines([[0.0, 0.0, 0.0]], [np.diag([1.0, 4.0, 0.0])])
    assert np.abs(np.asarray(flat.points)[:, 2]).max() == 0.0


def test_an_empty_map_is_empty_geometry():
    for tensor in (False, True):
        assert planes_to_mesh([], tensor=tensor).is_empty()
        assert outlines_to_lines([], tensor=tensor).is_empty()
        points_to_cloud(np.empty((0, 3)), tensor=tensor)
    only_lines = planes_to_mesh([wall(seen=LineString([(0, 0), (1, 0)]))], colour_by="sigma")
    assert only_lines.is_empty()


@pytest.mark.parametrize(
    ("draw", "sentence"),
    [
        (lambda: planes_to_mesh([wall()], colour_by="age"), "colour_by: expected 'plane' or 'sigma', got 'age'"),
        (lambda: planes_to_mesh([wall()], colour_by="sigma", sigma_limit_m=0.0), "sigma_limit_m: expected a positive"),
        (lambda: planes_to_mesh([1.0]), "planes: expected a Plane or MapPlane.*got float"),
        (lambda: planes_to_mesh(np.eye(4)), "planes: expected a Plane or MapPlane.*got ndarray"),
        (lambda: planes_to_mesh("planes"), "planes: expected a Plane or MapPlane.*got str"),
        (lambda: planes_to_mesh(None), "planes: expected a Plane or MapPlane.*got NoneType"),
        (lambda: points_to_cloud(np.zeros((2, 4))), r"points: expected shape \(..., 3\), got \(2, 4\)"),
        (lambda: points_to_cloud(np.zeros((2, 3)), np.zeros(2)), r"labels: expected integers of shape \(2,\)"),
        (lambda: trajectory_to_lines(np.eye(4)), r"trajectory: expected shape \(N, 4, 4\), got \(4, 4\)"),
        (lambda: trajectory_to_lines(None), "trajectory: expected a Trajectory.*got NoneType"),
        (lambda: ellipsoids_to_lines([[0, 0]], [np.eye(3)]), "centres: expected shape"),
        (lambda: ellipsoids_to_lines([[0, 0, 0]], [np.eye(2)]), "covariances: expected shape"),
        (lambda: ellipsoids_to_lines([[0, 0, 0]], [-np.eye(3)]), "covariances: expected a positive semidefinite"),
        (lambda: ellipsoids_to_lines([[0, 0, 0]], [np.eye(3)], confidence=1), "confidence: expected a probability"),
    ],
)
def test_what_cannot_be_drawn_says_what_is_wanted(draw, sentence):
    with pytest.raises(ValueError, match=sentence):
        draw()


def test_what_one_would_hand_in_is_taken():
    """One plane, a run, a cloud as it was read."""
    run, one = SimpleNamespace(planes=two_planes()), two_planes()[:1]
    assert len(planes_to_mesh(run).vertices) == len(planes_to_mesh(two_planes()).vertices)
    assert len(planes_to_mesh(one[0]).vertices) == len(planes_to_mesh(one).vertices)
    cloud = Cloud(np.array([[1.0, 2.0, 3.0], [np.nan] * 3]))
    assert len(points_to_cloud(cloud).points) == 1
