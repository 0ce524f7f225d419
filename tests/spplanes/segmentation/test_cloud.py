"""One call from a cloud, in whatever it comes, to labels and planes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spplanes import Plane, segment_cloud
from spplanes.clouds.scatter import scatter_along_beams
from spplanes.segmentation.cloud_search import CloudSearch
from tests.spplanes.scenes import spun, to_walls

try:
    import open3d as o3d
except (ImportError, OSError):
    o3d = None

EYE = np.array([0.4, -0.3, 0.2])
HALF = np.array([2.0, 1.5, 1.2])
SIGMA_M = 0.004
#: As many as the room has.
POINTS = np.random.default_rng(0).normal(size=(7200, 3))


def seen_from_eye(rows: int, columns: int) -> np.ndarray:
    """A box seen from `EYE`, shape (rows, columns, 3), in the sensor's frame, with noise along the beams."""
    rays = spun(np.linspace(0.9, -0.9, rows), np.linspace(-np.pi, np.pi, columns, False) + 0.013)
    ranges = to_walls(rays, -HALF - EYE, HALF - EYE)
    return rays * (ranges + SIGMA_M * np.random.default_rng(0).normal(size=ranges.shape))[..., None]


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    grid = seen_from_eye(40, 180)
    grid[3, 5:9] = np.nan
    return grid


def check(points: np.ndarray, labels: np.ndarray, planes: list, centre: np.ndarray) -> None:
    """The six walls of the box around ``centre``, one maybe cut in two, and every label tells a wall of its point."""
    assert 6 <= len(planes) <= 7
    assert len({tuple(np.rint(plane.normal)) for plane in planes}) == 6
    assert labels.shape == points.shape[:-1]
    assert labels.dtype == np.int32
    for plane in planes:
        axis = int(np.abs(plane.normal).argmax())
        assert abs(plane.distance(centre)) == pytest.approx(HALF[axis], abs=0.005)
        assert plane.outline is not None
    held = labels >= 0
    assert held[np.isfinite(points[..., 0])].mean() > 0.97
    far = [abs(planes[label].distance(point)) for point, label in zip(points[held], labels[held], strict=True)]
    assert max(far) < 6.0 * SIGMA_M
    assert [np.count_nonzero(labels == k) for k in range(len(planes))] == [plane.n_points for plane in planes]


def test_grids_lists_of_points_and_tables_give_the_same_walls(room):
    flat = room.reshape(-1, 3)
    mixed = np.random.default_rng(1).permutation(flat)
    table = np.zeros(room.shape[:2], dtype=[("intensity", "u1"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    for k, axis in enumerate("xyz"):
        table[axis] = room[..., k]
    for given, points in ((room, room), (flat, flat), (mixed, mixed), (mixed.astype(np.float32), mixed)):
        check(points, *segment_cloud(given), -EYE)
    for given, points in ((table, room), (table.ravel(), flat)):
        check(points, *segment_cloud(given, sigma=SIGMA_M), -EYE)


@pytest.mark.parametrize("copies", [(1, 2), (3, 1)], ids=["written twice", "lines thrice"])
def test_points_repeated_in_a_grid_are_counted_and_make_no_plane_more_certain(room, copies: tuple[int, int]):
    """Once they were on planes twice, on none less than never, and the error that neighbours share was theirs."""
    lines, whole = copies
    grid = np.concatenate([np.repeat(room, lines, axis=0)] * whole)
    once, found = segment_cloud(room), segment_cloud(grid)
    used = np.count_nonzero(np.isfinite(room[..., 0]))
    counts = found.coverage
    assert counts.repeated == (lines * whole - 1) * used and counts.on_planes + counts.on_no_plane == used
    assert counts.on_planes == sum(plane.n_points for plane in found.planes)
    own, copied = found.labels[: lines * len(room) : lines], found.labels[lines - 1 :: lines][-len(room) :]
    np.testing.assert_array_equal(own, copied)
    assert [np.count_nonzero(own == k) for k in range(len(found.planes))] == [one.n_points for one in found.planes]
    assert len(found.planes) == len(once.planes)
    for ours, theirs in zip(found.planes, once.planes, strict=True):
        assert ours.n_points == pytest.approx(theirs.n_points, rel=0.02)
        np.testing.assert_allclose(np.diag(ours.covariance), np.diag(theirs.covariance), rtol=0.1)


@pytest.mark.skipif(o3d is None, reason="open3d cannot be imported")
def test_open3d_clouds(room):
    flat = room.reshape(-1, 3)
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(flat))
    tensor = o3d.t.geometry.PointCloud(o3d.core.Tensor(flat))
    expected = segment_cloud(flat)[0]
    for cloud in (legacy, tensor):
        labels, planes = segment_cloud(cloud)
        check(flat, labels, planes, -EYE)
        np.testing.assert_array_equal(labels, expected)
    with pytest.raises(ValueError, match="cloud: expected a point cloud with positions, got one without"):
        segment_cloud(o3d.t.geometry.PointCloud())


def test_noise_that_is_not_shown_is_asked_for(room):
    message = "sigma: expected a standard deviation, for the cloud shows no flat places"
    for no_planes in (room.reshape(-1, 3)[:20], np.random.default_rng(0).normal(size=(4_000, 3))):
        with pytest.raises(ValueError, match=message):
            segment_cloud(no_planes)


def inward(planes: list) -> list[bool]:
    """Whether the normals point into the room."""
    return [bool(plane.normal @ (-EYE - plane.centre) > 0.0) for plane in planes]


def outward_normals(points: np.ndarray) -> np.ndarray:
    """Of the walls that points (N, 3) of the room lie on, out of it, shape (N, 3); NaN where there is none."""
    off = (points + EYE) / HALF
    axis = np.abs(np.nan_to_num(off)).argmax(axis=1)
    return np.eye(3)[axis] * np.sign(off[np.arange(len(off)), axis])[:, None]


@pytest.mark.skipif(o3d is None, reason="open3d cannot be imported")
def test_a_viewpoint_that_is_given_wins_over_the_normals_of_an_open3d_cloud(room):
    flat = room.reshape(-1, 3)
    flat = flat[np.isfinite(flat[:, 0])]
    legacy = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(flat))
    legacy.normals = o3d.utility.Vector3dVector(outward_normals(flat))
    for cloud in (legacy, o3d.t.geometry.PointCloud.from_legacy(legacy)):
        assert not any(inward(segment_cloud(cloud).planes))
        assert all(inward(segment_cloud(cloud, viewpoint=(0.0, 0.0, 0.0)).planes))


@pytest.mark.parametrize("viewpoint", [None, (0.0, 0.0, 0.0)])
def test_planes_whose_normals_tell_no_side_turn_to_the_viewpoint(room, viewpoint):
    flat = room.reshape(-1, 3)
    normals = outward_normals(flat)
    either = normals * np.random.default_rng(2).choice([-1.0, 1.0], len(flat))[:, None]
    for useless in (np.zeros_like(flat), np.full_like(flat, np.nan), either):
        assert all(inward(segment_cloud(flat, normals=useless, viewpoint=viewpoint).planes))
    few = np.where(np.random.default_rng(3).random((len(flat), 1)) < 0.9, np.nan, normals)
    for telling in (normals, 0.01 * normals, few):
        assert not any(inward(segment_cloud(flat, normals=telling, viewpoint=viewpoint).planes))
    ceiling = np.where(np.abs(normals[:, 2:]) > 0.5, 0.0, normals)  # and the floor tell nothing
    planes = segment_cloud(flat, normals=ceiling, viewpoint=viewpoint).planes
    assert inward(planes) == [abs(plane.normal[2]) > 0.5 for plane in planes]


def test_nobody_judges_by_a_viewpoint_that_was_not_given_where_normals_turn_the_planes(room):
    flat, far = room.reshape(-1, 3), np.array([1000.0, 0.0, 0.0])
    normals, flat = outward_normals(flat), flat + far
    told = segment_cloud(flat)
    assert any("viewpoint" in one for one in told.warnings) and "edge-on" in told.flags
    found = segment_cloud(flat, normals=normals)
    assert not found.warnings and not any(found.flags)
    given = segment_cloud(flat, normals=normals, viewpoint=(0.0, 0.0, 0.0))
    assert given.warnings == told.warnings and "edge-on" in given.flags


HOLES = {
    "half": lambda i, j: np.random.default_rng(4).random(i.shape) < 0.5,
    "60 %": lambda i, j: np.random.default_rng(4).random(i.shape) < 0.6,
    "every second row": lambda i, j: i % 2 == 1,
    "every second column": lambda i, j: j % 2 == 1,
    "three rows of four": lambda i, j: i % 4 > 0,
    "a chequerboard": lambda i, j: (i + j) % 2 == 1,
}


@pytest.mark.parametrize("missing", HOLES.values(), ids=HOLES)
def test_a_grid_that_is_mostly_holes_has_its_planes_all_the_same(missing):
    grid = seen_from_eye(120, 360)
    grid[missing(*np.indices(grid.shape[:2]))] = np.nan
    found, flat = segment_cloud(grid), segment_cloud(grid.reshape(-1, 3))
    walls, returns = found.planes[:6], np.isfinite(grid[..., 0])
    assert len(found.planes) <= 7 and len({tuple(np.rint(plane.normal)) for plane in walls}) == 6
    for plane in walls:
        assert abs(plane.distance(-EYE)) == pytest.approx(HALF[int(np.abs(plane.normal).argmax())], abs=0.002)
    assert ((found.labels >= 0) & (found.labels < 6))[returns].mean() > 0.95
    np.testing.assert_array_equal(found.labels.ravel(), flat.labels)
    assert found.coverage == flat.coverage and found.coverage.share > 0.97
    assert found.coverage.no_return == np.count_nonzero(~returns)
    assert found.flags == flat.flags and not any(found.flags[:6])


def test_a_grid_with_few_holes_is_searched_as_a_grid(room, monkeypatch):
    holes = np.where(np.random.default_rng(5).random((*room.shape[:2], 1)) < 0.15, np.nan, room)
    monkeypatch.setattr(CloudSearch, "of_points", None)
    for grid in (room, holes, room[:1]):
        assert segment_cloud(grid, sigma=SIGMA_M).labels.shape == grid.shape[:2]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"normals": np.ones((40, 3))}, r"normals: expected none for a grid \(S, B, 3\), whose planes turn to"),
        ({"viewpoint": (0.0, 0.0)}, r"viewpoint: expected shape \(3,\), got \(2,\)"),
        ({"config": {}}, "config: expected a MapperConfig, got dict"),
        ({"cloud": POINTS, "normals": POINTS[:5]}, r"normals: expected shape \(7200, 3\)"),
        ({"cloud": POINTS, "viewpoint": (0.0, 0.0)}, r"viewpoint: expected shape \(3,\) or \(7200, 3\), got"),
        ({"cloud": POINTS, "viewpoint": POINTS[1:]}, r"viewpoint: expected shape \(3,\) or \(7200, 3\), got"),
        ({"cloud": np.zeros((4, 2))}, r"cloud: expected shape \(N, 3\) or \(S, B, 3\), got \(4, 2\)"),
        ({"cloud": np.zeros(4, [("x", "f8"), ("y", "f8")])}, "cloud: expected the fields x, y, z, got x, y"),
        ({"cloud": "cloud.ply"}, "cloud: expected an array of numbers, got str"),
        ({"cloud": None}, "cloud: expected"),
        ({"cloud": np.full((9, 3), np.nan)}, "cloud: expected at least three points, got 0"),
    ],
)
def test_what_is_no_cloud_and_what_none_is_searched_with(room, given, message):
    with pytest.raises(ValueError, match=message):
        segment_cloud(**{"cloud": room, **given})


@pytest.mark.parametrize("thickness_m, sigma_m", [(0.2, 0.005), (0.05, 0.005), (0.02, 0.002)])
def test_a_wall_seen_from_both_sides_is_two_planes(thickness_m: float, sigma_m: float):
    """Alone in its cloud: cells must be so large to look flat that they hold both sides, and then points scatter."""
    rng = np.random.default_rng(0)
    back = rng.random(20_000) < 0.4
    x = np.where(back, thickness_m, 0.0)
    wall = np.stack((x, rng.uniform(-2.0, 2.0, 20_000), rng.uniform(0.0, 2.5, 20_000)), axis=1)
    wall += sigma_m * rng.normal(size=wall.shape)
    eyes = np.where(back[:, None], [3.0, 0.0, 1.2], [-3.0, 0.0, 1.2])
    found = segment_cloud(wall, sigma=sigma_m, viewpoint=eyes)
    assert [round(float(plane.normal[0])) for plane in found.planes] == [-1, 1]
    for plane, true_x in zip(found.planes, (0.0, thickness_m), strict=True):
        assert abs(plane.centre[0] - true_x) < 4.0 * float(np.sqrt(plane.covariance[0, 0])) < 0.001
    assert np.mean(found.labels == back) > 0.99 and not found.warnings
    told = segment_cloud(wall, sigma=sigma_m, viewpoint=(-3.0, 0.0, 1.2))  # from one side nobody can tell
    assert len(told.planes) > 1 or any("both sides of a wall" in sentence for sentence in told.warnings)


@pytest.mark.parametrize("as_grid", [True, False])
def test_walls_whose_noise_is_wider_than_their_points_are_apart_are_one_plane_each(as_grid: bool):
    """A depth camera in a corner, 20 mm of noise at 3 m that grows with the square of the range, 12 mm from beam to
    beam: along rows and columns neighbours are none, and cells that show the noise of near walls are balls of far ones.
    """
    elevation, azimuth = np.deg2rad(np.linspace(-40.0, 40.0, 240)), np.deg2rad(np.linspace(-35.0, 35.0, 320))
    turned = Rotation.from_euler("zy", (40.0, 10.0), degrees=True).as_matrix()
    rays, half = spun(elevation, azimuth), np.array([4.0, 3.0, 1.5])
    eye = np.array([0.3, -0.4, 0.2])
    ranges = to_walls(rays @ turned.T, -half - eye, half - eye)
    noise = 0.02 * (ranges / 3.0) ** 2 * np.random.default_rng(0).normal(size=ranges.shape)
    cloud = (ranges + noise)[..., None] * rays
    found = segment_cloud(cloud if as_grid else cloud.reshape(-1, 3), viewpoint=np.zeros(3))
    assert len(found.planes) == 4 and found.coverage.share > 0.97
    for plane in found.planes:
        normal = turned @ plane.normal
        axis = int(np.abs(normal).argmax())
        place = abs((turned @ plane.centre + eye)[axis])
        assert abs(normal[axis]) > np.cos(2e-3) and place == pytest.approx(half[axis], abs=2e-3)


@pytest.mark.parametrize("given", ["grid", "points", "points of nowhere"])
def test_planes_of_cameras_with_growing_noise_are_as_sure_as_they_say(given: str):
    """30 rooms, turned any way, by a depth camera whose noise grows with the square of the range, 20 mm at 3 m.

    Errors of their 85 planes over their covariances: half of chi2 of 3 dof lies below 2.37, and measured is 3.6, for
    seams of 20 mm are soft; where points weigh by the range at which they or their neighbours were measured, 6.6; where
    noise is taken to lie along normals because nobody said from where the points were seen, 7.1.
    """
    rng, squares = np.random.default_rng(5), []
    rays = spun(np.deg2rad(np.linspace(-22.0, 22.0, 240)), np.deg2rad(np.linspace(-29.0, 29.0, 320)))
    for _ in range(30):
        angles = rng.uniform((-60.0, -20.0, -5.0), (60.0, 20.0, 5.0))
        turned = Rotation.from_euler("zyx", angles, degrees=True).as_matrix()
        low, high = (side * rng.uniform((1.2, 1.2, 1.0), (3.5, 3.5, 1.5)) for side in (-1.0, 1.0))
        ranges = to_walls(rays @ turned.T, low, high)
        ranges += 0.02 * (ranges / 3.0) ** 2 * rng.normal(size=ranges.shape)
        cloud = ranges[..., None] * rays
        eye = None if given == "points of nowhere" else np.zeros(3)
        for plane in segment_cloud(cloud if given == "grid" else cloud.reshape(-1, 3), viewpoint=eye).planes:
            normal = turned @ plane.normal
            axis = int(np.abs(normal).argmax())
            place = high[axis] if (turned @ plane.centre)[axis] > 0.0 else low[axis]
            facing = np.sign(normal[axis])
            squares.append(plane.mahalanobis(Plane.from_hesse(facing * turned[axis], facing * place, np.zeros((3, 3)))))
    assert 1.6 < np.median(squares) < 4.2
    assert np.mean(np.array(squares) > 16.27) < 0.12


@pytest.mark.parametrize("place_m", [0.0, 1.5, 6.0])
def test_noise_lies_along_beams_from_the_origin_only_where_points_scatter_so(place_m: float):
    """A box of points even over its faces: with noise alike every way, and with that of a laser in the origin."""
    rng, half = np.random.default_rng(2), np.array([3.0, 2.5, 2.0])
    labels = rng.integers(6, size=30_000)
    axis, side = labels % 3, labels // 3 * 2.0 - 1.0
    exact = half * rng.uniform(-1.0, 1.0, (30_000, 3))
    exact[np.arange(30_000), axis] = side * half[axis]
    exact += place_m
    normals = np.vstack((-np.eye(3), np.eye(3)))
    planes = np.column_stack((normals, np.tile(half, 2) + normals @ np.full(3, place_m)))
    eyes, noise = np.zeros((30_000, 3)), 0.02 * rng.normal(size=(30_000, 3))
    along = exact / np.linalg.norm(exact, axis=1, keepdims=True) * noise[:, :1]
    assert not scatter_along_beams(exact + noise, eyes, labels, planes)
    assert scatter_along_beams(exact + along, eyes, labels, planes)
