import numpy as np
import pytest

from benchmarks._boxes import polyhedra_scan
from benchmarks.scenes import correct_detections
from spplanes import MapperConfig, Plane, PlaneMapper, segment_scans
from tests.spplanes.scenes import anywhere, beam_covariances, box, cast, noisy, rays
from tests.statistics import assert_mean_in_band

SIGMA = 0.005
ONES, NEGATIVE = np.ones((4, 4, 3)), {"sigma": 0.1, "pose_covariances": -np.tile(np.eye(6), (4, 1, 1))}
WALL = cast(rays(), [((1, 0, 0), 3.0, anywhere)])[0]


def test_room_is_five_whole_planes_seen_from_inside():
    exact, truth = cast(rays(), box())
    points = noisy(exact, SIGMA, 0)
    labels, planes = segment_scans(points, beam_covariances(exact, SIGMA), viewpoints=(0.0, 0.0, 0.0))
    assert correct_detections(labels, truth + 1, 0.95) == 5
    assert len(planes) == 5
    for k, plane in enumerate(planes):
        normal, d, _ = box()[int(np.bincount(truth[labels == k]).argmax())]
        assert plane.normal @ -np.asarray(normal) > np.cos(0.01)
        assert plane.d == pytest.approx(-d, abs=0.01)
        assert plane.n_points == (labels == k).sum()
        assert plane.outline.is_valid


def test_without_viewpoint_distances_are_positive_labels_in_order_and_missing_points_no_returns():
    points = noisy(cast(rays(), box())[0], SIGMA, 11)
    points[5, 5], points[6, 6, 0] = np.inf, np.nan
    labels, planes = segment_scans(points, sigma=SIGMA)
    assert labels[5, 5] == labels[6, 6] == -1
    assert len(planes) == 5
    assert all(plane.d >= 0.0 for plane in planes)
    firsts = [np.flatnonzero(labels.ravel() == k)[0] for k in range(len(planes))]
    assert firsts == sorted(firsts)
    assert labels.dtype == np.int32


def test_covariance_is_honest():
    normal = np.array([1.0, 0.3, 0.2])
    normal /= np.linalg.norm(normal)
    exact, _ = cast(rays(24, 32, 0.4), [(normal, 3.0, anywhere)])
    covariances, runs, values = beam_covariances(exact, 0.01), 150, []
    for seed in range(runs):
        _, planes = segment_scans(noisy(exact, 0.01, seed), covariances, viewpoints=(0.0, 0.0, 0.0))
        assert len(planes) == 1
        values.append(planes[0].mahalanobis(Plane.from_hesse(-normal, -3.0, np.zeros((3, 3)))))
    assert_mean_in_band(values, 3, 0.998)


def test_stated_surface_errors_shift_planes_alike_and_tilt_larger_ones_less():
    added = []
    for scale in (1.0, 4.0):
        points = noisy(scale * WALL, SIGMA, 4)
        plain = segment_scans(points, sigma=SIGMA)[1][0]
        floor = segment_scans(points, sigma=SIGMA, config=MapperConfig(surface_sigma_m=0.01))[1][0]
        added.append(np.diag(floor.covariance - plain.covariance))
    assert 1e-4 < added[0][0] < 4e-4  # an octave longer than the plane, and what is left of those on it
    np.testing.assert_allclose(added[1], added[0] / [1.0, 16.0, 16.0], rtol=0.02)


@pytest.mark.parametrize(("step", "expected"), [(0.03, 2), (0.0, 1)])
def test_parallel_planes_centimetres_apart_stay_two(step, expected):
    scene = [((1, 0, 0), 3.0, lambda p: p[..., 1] > 0.0), ((1, 0, 0), 3.0 + step, lambda p: p[..., 1] <= 0.0)]
    points, truth = cast(rays(), scene)
    labels, planes = segment_scans(noisy(points, 0.01, 5), sigma=0.01, viewpoints=(0.0, 0.0, 0.0))
    assert len(planes) == expected
    if expected == 2:
        assert correct_detections(labels, truth + 1, 0.95) == 2


def test_a_jerking_mount_does_not_cut_a_wall_when_it_is_known():
    jerks = 0.03 * np.sin(np.arange(48) / 2.0)
    points = noisy(WALL, 0.005, 10) + jerks[:, None, None] * np.array([1.0, 0.0, 0.0])
    pose = np.tile(np.diag([4e-4, 4e-4, 4e-4, 0, 0, 0]), (48, 1, 1))
    assert len(segment_scans(points, sigma=0.005)[1]) > 1
    assert len(segment_scans(points, sigma=0.005, pose_covariances=pose)[1]) == 1


@pytest.mark.parametrize(
    "points",
    [
        *(np.ones((*shape, 3)) for shape in ((1, 40), (40, 1), (1, 1), (0, 5), (5, 0))),
        np.zeros((30, 40, 3)),
        np.full((8, 9, 3), np.nan),
        rays() * np.random.default_rng(9).uniform(1.0, 4.0, (48, 64, 1)),
    ],
    ids=["a row", "a column", "a point", "no row", "no column", "zero range", "no return", "clutter"],
)
def test_grids_without_a_surface_have_no_planes(points):
    labels, planes = segment_scans(points, sigma=SIGMA, viewpoints=np.zeros(3))
    assert labels.shape == points.shape[:2]
    assert planes == []
    assert (labels == -1).all()


def test_the_plane_of_a_scan_is_no_surface():
    points, covariances, origins, _ = corridor_slices(2, 0)
    points[1] = np.nan
    for n in (1, 2):
        assert segment_scans(points[:n], covariances[:n], viewpoints=origins[:n])[1] == []


@pytest.mark.parametrize(
    ("points", "kwargs", "message"),
    [
        ([[[0, 0, 0]], [[0, 0, 0], [1, 1, 1]]], {"sigma": 0.1}, "points: expected scans of equal length"),
        (np.zeros((4, 3)), {"sigma": 0.1}, r"points: expected shape \(S, B, 3\), got \(4, 3\)"),
        (np.zeros((4, 4, 3)), {}, "expected exactly one of covariances and sigma"),
        (np.zeros((4, 4, 3)), {"sigma": 0.0}, "sigma: expected a positive finite number"),
        (ONES, {"sigma": -np.ones((4, 4))}, "sigma: expected positive finite numbers"),
        (ONES, {"covariances": np.eye(3)}, r"covariances: expected shape \(4, 4, 3, 3\)"),
        (ONES, {"covariances": np.tile(-np.eye(3), (4, 4, 1, 1))}, "positive semidefinite"),
        (ONES, NEGATIVE, "pose_covariances: expected a positive semidefinite covariance"),
        (ONES, {"sigma": 0.1, "viewpoints": np.zeros((3, 3))}, r"viewpoints: expected shape \(4, 3\)"),
        (ONES, {"sigma": 0.1, "pose_covariances": np.eye(6)}, r"pose_covariances: expected shape \(4, 6"),
    ],
)
def test_bad_input_is_one_sentence(points, kwargs, message):
    covariances = kwargs.pop("covariances", None)
    with pytest.raises(ValueError, match=message):
        segment_scans(points, covariances, **kwargs)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("significance", 0.0),
        ("flatness_m", -1.0),
        ("gate_sigma", np.nan),
        ("max_incidence_rad", 2.0),
        ("min_points", 2),
        ("strip_scans", 1),
        ("pose_correlation_scans", -1.0),
    ],
)
def test_config_is_checked(field, value):
    with pytest.raises(ValueError, match=field):
        MapperConfig(**{field: value})


def test_literal_edge_test_throws_a_good_wall_away():
    points, covariances = noisy(WALL, 0.005, 12), beam_covariances(WALL, 0.005, 0.003)
    assert len(segment_scans(points, covariances)[1]) == 1
    assert segment_scans(points, covariances, config=MapperConfig(literal_edge_test=True))[1] == []


def corridor_slices(n_scans, seed=0, sigma=0.015):
    """Scans of an upright laser 1 m above the floor of a corridor 2 m wide and 2.5 m high, 27 mm apart."""
    rng, angles = np.random.default_rng(seed), np.radians(np.arange(-90.0, 90.5, 0.5))
    rays = np.column_stack((np.zeros(361), np.cos(angles), np.sin(angles)))
    walls = np.array([[0.0, 1.0, 0.0, 1.0], [0.0, 0.0, -1.0, 1.0], [0.0, 0.0, 1.0, 1.5]])
    with np.errstate(divide="ignore"):
        reach = walls[:, 3:] / (walls[:, :3] @ rays.T)
    reach[reach <= 0.0] = np.inf
    ranges = reach.min(axis=0) + sigma * rng.standard_normal((n_scans, 361))
    origins = np.column_stack((0.027 * np.arange(n_scans), np.zeros(n_scans), np.zeros(n_scans)))
    covariances = sigma**2 * rays[:, :, None] * rays[:, None, :] + 1e-6 * np.eye(3)
    points = origins[:, None] + ranges[..., None] * rays
    return points, np.tile(covariances, (n_scans, 1, 1, 1)), origins, reach.argmin(axis=0)


@pytest.mark.parametrize("n_scans", [2, 3, 10])
def test_few_scans_are_represented_whole(n_scans):
    for seed in range(3):
        points, covariances, origins, truth = corridor_slices(n_scans, seed)
        labels, planes = segment_scans(points, covariances, viewpoints=origins)
        assert (labels >= 0).mean() > 0.995
        major = np.array([np.bincount(np.tile(truth, (n_scans, 1))[labels == k]).argmax() for k in range(len(planes))])
        assert (major[labels] == truth).mean() > 0.985
        for k, plane in enumerate(planes):
            across = [[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]][major[k]]
            if plane.n_points > 60:
                tilt = np.sqrt(plane.covariance[1:, 1:].diagonal().max())
                assert np.arccos(plane.normal @ across) < 4.0 * tilt + 0.01
                assert plane.covariance[0, 0] < 0.01**2


def test_few_scans_one_after_the_other():
    points, covariances, origins, _ = corridor_slices(2)
    mapper = PlaneMapper(MapperConfig(keep_labels=True))
    for k in range(2):
        mapper.add_scan(points[k], covariances[k], viewpoint=origins[k])
    assert mapper.n_points_represented == (mapper.labels() >= 0).sum() > 0.995 * mapper.n_points_seen
    np.testing.assert_array_equal(mapper.labels(), segment_scans(points, covariances, viewpoints=origins)[0])


@pytest.mark.parametrize("groove", [0.0, 0.008])
def test_a_groove_no_deeper_than_the_noise_parts_two_cushions(groove):
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, 160), np.linspace(-0.3, 0.3, 96))
    seam = np.abs(y) < 0.025
    depth = 2.0 + groove * seam + 0.008 * np.random.default_rng(0).standard_normal(y.shape)
    labels, planes = segment_scans(np.stack((depth, y, z), axis=-1), sigma=0.008)
    assert len(planes) == (2 if groove else 1)
    if groove:
        assert (labels[y < -0.05] == labels[0, 0]).mean() > 0.98
        assert (labels[y > 0.05] == labels[0, -1]).mean() > 0.98


def test_rooms_of_polyhedra():
    points, covariances, truth = polyhedra_scan(3, size=250)
    labels, _ = segment_scans(points, covariances, viewpoints=np.zeros(3))
    large = [k for k in np.unique(truth) if (truth == k).sum() > 100]
    assert correct_detections(labels, np.where(np.isin(truth, large), truth + 1, 0)) >= 0.85 * len(large)


def test_a_plane_goes_on_behind_what_stands_before_it_but_not_past_a_doorway():
    y, z = np.meshgrid(np.linspace(-1.5, 1.5, 120), np.linspace(-0.5, 0.5, 48))
    for middle, expected in ((1.5, 1), (4.0, 2)):
        points = np.stack((np.full(y.shape, 3.0), y, z), axis=-1)
        points[:, 45:75, 0] = middle
        points[:, :, 0] += 0.005 * np.random.default_rng(1).standard_normal(y.shape)
        labels, _ = segment_scans(points, sigma=0.005, viewpoints=np.zeros(3))
        assert len(np.unique(labels[:, [10, 110]])) == expected


def wall_with_a_board(board_m, size, seed):
    """A wall 3 m ahead seen to 1 cm, 64 x 96 points, with a board of size x size points before it."""
    y, z = np.meshgrid(np.linspace(-1.0, 1.0, 96), np.linspace(-0.6, 0.6, 64))
    x = 3.0 + 0.01 * np.random.default_rng(seed).standard_normal(y.shape)
    x[24 : 24 + size, 40 : 40 + size] -= board_m
    return np.stack((x, y, z), axis=-1)


def test_a_board_nearer_to_its_wall_than_points_scatter_is_no_part_of_it():
    """Point for point 15 mm pass the gate of 35 mm: only whole cells of them tell."""
    for seed in range(3):
        labels, planes = segment_scans(wall_with_a_board(0.015, 16, seed), sigma=0.01, viewpoints=np.zeros(3))
        assert len(planes) == 2
        assert (labels[26:38, 42:54] != labels[5, 5]).all()


@pytest.mark.parametrize(("scans", "expected"), [(100.0, 2), (0.0, 1)])
def test_an_error_that_scans_share_hides_a_board_unless_it_moves_board_and_wall_alike(scans, expected):
    """Each scan may be 1 cm off, half of what the board stands out; scans side by side err alike, or they do not."""
    pose = np.tile(np.diag([1e-4, 1e-4, 1e-4, 0.0, 0.0, 0.0]), (64, 1, 1))
    config = MapperConfig(pose_correlation_scans=scans)
    for seed in range(3):
        points = wall_with_a_board(0.02, 32, seed)
        labels, planes = segment_scans(points, sigma=0.01, viewpoints=np.zeros(3), pose_covariances=pose, config=config)
        assert len(planes) == expected
        assert (labels[30:50, 46:66] != labels[5, 5]).all() == (expected == 2)


@pytest.mark.parametrize(("size", "expected"), [(7, 1), (16, 2)])
def test_a_patch_of_fewer_points_than_asked_is_no_plane(size, expected):
    labels, planes = segment_scans(wall_with_a_board(0.5, size, 0), sigma=0.01, viewpoints=np.zeros(3))
    assert len(planes) == labels.max() + 1 == expected
