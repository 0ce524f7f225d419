"""One call from a cloud, in whatever it comes, to labels and planes."""

import numpy as np
import pytest

from spplanes import segment_cloud
from tests.spplanes.scenes import spun, to_walls

try:
    import open3d as o3d
except (ImportError, OSError):
    o3d = None

EYE = np.array([0.4, -0.3, 0.2])
HALF = np.array([2.0, 1.5, 1.2])
SIGMA_M = 0.004


@pytest.fixture(scope="module")
def room() -> np.ndarray:
    """A box seen from `EYE`, shape (40, 180, 3), in the sensor's frame, with noise along the beams."""
    rays = spun(np.linspace(0.9, -0.9, 40), np.linspace(-np.pi, np.pi, 180, False) + 0.013)
    ranges = to_walls(rays, -HALF - EYE, HALF - EYE)
    ranges += SIGMA_M * np.random.default_rng(0).normal(size=ranges.shape)
    grid = rays * ranges[..., None]
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


def test_grids_and_lists_of_points_give_the_same_walls(room):
    flat = room.reshape(-1, 3)
    mixed = np.random.default_rng(1).permutation(flat)
    for points in (room, flat, mixed, mixed.astype(np.float32)):
        labels, planes = segment_cloud(points)
        check(np.asarray(points, dtype=np.float64), labels, planes, -EYE)


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


def test_structured_arrays(room):
    table = np.zeros(room.shape[:2], dtype=[("intensity", "u1"), ("x", "f8"), ("y", "f8"), ("z", "f8")])
    for k, axis in enumerate("xyz"):
        table[axis] = room[..., k]
    for given in (table, table.ravel()):
        labels, planes = segment_cloud(given, sigma=SIGMA_M)
        check(room.reshape(*given.shape, 3), labels, planes, -EYE)


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


def test_the_noise_is_measured_or_asked_for(room):
    sigmas = [np.sqrt(plane.covariance[0, 0] * plane.n_points) for plane in segment_cloud(room)[1]]
    assert np.median(sigmas) == pytest.approx(SIGMA_M, rel=0.5)
    with pytest.raises(ValueError, match="sigma: expected a standard deviation, for the cloud has too few neighbours"):
        segment_cloud(room.reshape(-1, 3)[:20])


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (np.zeros((4, 2)), r"cloud: expected shape \(N, 3\) or \(S, B, 3\), got \(4, 2\)"),
        (np.zeros(4, dtype=[("x", "f8"), ("y", "f8")]), "cloud: expected the fields x, y, z, got x, y"),
        ("cloud.ply", "cloud: expected an array of numbers, got str"),
        (None, "cloud: expected"),
        (np.full((9, 3), np.nan), "cloud: expected at least three points, got 0"),
    ],
)
def test_what_is_no_cloud(cloud, message):
    with pytest.raises(ValueError, match=message):
        segment_cloud(cloud)
