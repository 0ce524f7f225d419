from dataclasses import replace

import numpy as np
import pytest

from spplanes import MapperConfig, Plane, PlaneMapper, fit_plane, fit_planes, segment_scans
from spplanes.fitting import _own_noise, _pose_error
from spplanes.mapping._region_table import RegionTable
from spplanes.moments import points_row
from tests.spplanes.scenes import beam_covariances
from tests.statistics import assert_mean_in_band

SIGMA = 0.01
SMALL = MapperConfig(strip_scans=16, lookahead_scans=4)
#: Of the planes of the corridor.
NORMALS, DISTANCES = np.array([(0, -1, 0), (0, 1, 0), (0, 0, -1)]), (-1.0, -1.0, -1.5)


def corridor(n_scans, seed=0, n_beams=120, sigma=SIGMA):
    """A vertical scanner driven along x through a corridor 2 m wide and 2 m high: points, covariances, eyes, truth."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, n_beams)
    u = np.column_stack((np.zeros(n_beams), np.sin(angles), np.cos(angles)))
    with np.errstate(divide="ignore"):
        t = np.stack((1.0 / np.abs(u[:, 1]), np.where(u[:, 2] > 1e-9, 1.5 / u[:, 2], np.inf)))
    side = np.where(t[0] < t[1], np.where(u[:, 1] > 0, 0, 1), 2)
    ranges = t.min(axis=0) + sigma * np.random.default_rng(seed).standard_normal((n_scans, n_beams))
    eyes = np.column_stack((0.03 * np.arange(n_scans), np.zeros(n_scans), np.zeros(n_scans)))
    points = eyes[:, None] + ranges[..., None] * u
    covariances = np.broadcast_to(beam_covariances(u, sigma), (n_scans, n_beams, 3, 3))
    return points, covariances, eyes, np.tile(side, (n_scans, 1))


def standing(points, covariance):
    """Scans seen from the origin, all points as uncertain."""
    points = np.asarray(points)
    return points, np.broadcast_to(covariance, (*points.shape, 3)), np.zeros((len(points), 3)), None


def build(scans, config=SMALL, **kwargs):
    mapper = PlaneMapper(config)
    points, covariances, eyes, _ = scans
    for k in range(len(points)):
        mapper.add_scan(points[k], covariances[k], viewpoint=eyes[k], **kwargs)
    return mapper


def test_corridor_is_two_walls_and_a_ceiling():
    scans = corridor(100)
    mapper = build(scans, replace(SMALL, keep_labels=True))
    planes, labels = mapper.planes, mapper.labels()
    assert len(planes) == 3
    assert mapper.n_points_seen == 100 * 120
    assert mapper.n_points_represented >= 0.99 * mapper.n_points_seen
    assert mapper.n_points_represented == (labels >= 0).sum() == sum(plane.n_points for plane in planes)
    for k, plane in enumerate(planes):
        side = int(np.bincount(scans[3][labels == k]).argmax())
        assert (labels[scans[3] == side] == k).mean() > 0.97
        assert plane.normal @ NORMALS[side] > np.cos(0.005)
        assert plane.d == pytest.approx(DISTANCES[side], abs=0.003)
        assert plane.outline.area == pytest.approx(2.97 * (1.5 if side < 2 else 2.0), rel=0.07)


def test_incremental_agrees_with_all_at_once():
    points, covariances, eyes, _ = corridor(60, 1)
    labels, once = segment_scans(points, covariances, viewpoints=eyes)
    flat = points.reshape(-1, 3), covariances.reshape(-1, 3, 3), labels.ravel()
    whole = fit_planes(*flat, shared_error=False)  # at seams as well, where the mapper leaves nothing out
    bit_by_bit = build((points, covariances, eyes, None)).planes
    assert len(once) == len(bit_by_bit) == 3
    for plane, with_seams in zip(once, whole, strict=True):
        other = min(bit_by_bit, key=lambda q: -(q.normal @ plane.normal))
        assert other.n_points == pytest.approx(plane.n_points, rel=0.02)
        assert other.normal @ plane.normal > np.cos(0.002)
        np.testing.assert_allclose(np.diag(other.covariance), np.diag(with_seams.covariance), rtol=0.1)


def test_looking_at_the_planes_changes_nothing():
    scans = corridor(40, 2)
    watched = PlaneMapper(SMALL)
    for k in range(40):
        watched.add_scan(scans[0][k], scans[1][k], viewpoint=scans[2][k])
        assert watched.n_points_represented <= watched.n_points_seen == (k + 1) * 120
        assert isinstance(watched.planes, list)
    assert watched.planes == build(scans).planes


def test_memory_grows_with_planes_not_with_scans():
    short, long = (build(corridor(n, 3), replace(SMALL, outline_cell_m=0.5)) for n in (100, 400))
    assert long.memory_bytes - short.memory_bytes < 0.05 * 300 * 120 * 24
    with pytest.raises(ValueError, match="keep_labels"):
        short.labels()


def test_nothing_seen():
    mapper = PlaneMapper(replace(SMALL, keep_labels=True))
    assert (mapper.planes, mapper.n_points_seen, mapper.n_points_represented) == ([], 0, 0)
    for _ in range(50):
        mapper.add_scan(np.full((7, 3), np.nan), np.full((7, 3, 3), np.nan))
    assert (mapper.planes, mapper.n_points_seen, mapper.labels().shape) == ([], 0, (50, 7))


GOOD = np.ones((5, 3)), np.tile(np.eye(3), (5, 1, 1))


@pytest.mark.parametrize(
    ("points", "covariances", "more", "message"),
    [
        ([[1, 2, 3], [1, 2]], GOOD[1], {}, "points: expected an array of numbers"),
        (3.0, GOOD[1], {}, r"points: expected shape \(N, 3\), got \(\)"),
        (np.ones(3), GOOD[1], {}, r"points: expected shape \(N, 3\), got \(3,\)"),
        (1e13 * GOOD[0], GOOD[1], {}, r"points: expected coordinates up to 1e\+12 m"),
        (GOOD[0], GOOD[1][:4], {}, r"covariances: expected shape \(5, 3, 3\), .* got \(4, 3, 3\)"),
        (GOOD[0], 1e30 * GOOD[1], {}, "covariances: expected the largest entries in 1e-18 to"),
        (GOOD[0], -GOOD[1], {}, "covariances: expected positive semidefinite matrices"),
        (*GOOD, {"pose_covariance": np.eye(3)}, r"pose_covariance: expected shape \(6, 6\)"),
        (*GOOD, {"pose_covariance": -np.eye(6)}, "pose_covariance: expected a positive semidefinite covariance"),
        (*GOOD, {"viewpoint": [np.nan, 0.0, 0.0]}, "viewpoint: expected finite numbers"),
        (*GOOD, {"scan_origin": [np.inf, 0.0, 0.0]}, "scan_origin: expected finite numbers"),
    ],
)
def test_a_scan_that_is_refused_leaves_no_trace(points, covariances, more, message):
    mapper = PlaneMapper()
    with pytest.raises(ValueError, match=message):
        mapper.add_scan(points, covariances, **more)
    mapper.add_scan(np.ones((7, 3)), np.tile(np.eye(3), (7, 1, 1)))  # whatever its number of beams
    assert mapper.n_points_seen == 7


@pytest.mark.parametrize(
    ("n_beams", "message"),
    [
        (6, r"points: expected shape \(5, 3\), got \(6, 3\)"),
        (5, "viewpoint: expected one with every scan or with none, got none unlike"),
    ],
)
def test_all_scans_have_as_many_beams_and_viewpoints_come_with_all_or_none(n_beams, message):
    mapper = PlaneMapper()
    mapper.add_scan(*GOOD, viewpoint=np.zeros(3))
    with pytest.raises(ValueError, match=message):
        mapper.add_scan(np.ones((n_beams, 3)), np.tile(np.eye(3), (n_beams, 1, 1)))
    assert mapper.n_points_seen == 5


@pytest.mark.parametrize("n_scans", [1, 60])
@pytest.mark.parametrize(
    "scan",
    [
        np.empty((0, 3)),
        np.ones((1, 3)),
        np.zeros((50, 3)),
        np.full((50, 3), np.inf),
        np.column_stack((np.zeros(50), np.linspace(0.0, 3.0, 50), np.ones(50))),
    ],
    ids=["no beam", "one beam", "zero range", "infinite range", "a robot that stands still"],
)
def test_scans_that_span_no_plane_are_points(scan, n_scans):
    mapper = build(standing([scan] * n_scans, 1e-4 * np.eye(3)))
    assert mapper.planes == []
    assert mapper.n_points_represented == 0
    assert mapper.n_points_seen == n_scans * int(np.isfinite(scan).all(axis=1).sum())


def test_exact_points_and_singular_covariances_are_fine():
    scans = np.stack(np.meshgrid(np.arange(40) * 0.02, np.linspace(0.0, 3.0, 90), 1.0, indexing="ij"), axis=-1)
    (plane,) = build(standing(scans[:, :, 0], np.diag([0.0, 0.0, 1e-4]))).planes
    np.testing.assert_allclose(plane.normal, [0.0, 0.0, -1.0], atol=1e-12)
    assert np.isfinite(plane.covariance).all()


@pytest.mark.parametrize("decay", [0.0, 0.9])
def test_pose_errors_are_summed_with_their_correlation(decay):
    rng = np.random.default_rng(4)
    n_scans, n_beams = 12, 9
    points = np.concatenate((np.ones((n_scans, n_beams, 1)), rng.uniform(-1, 1, (n_scans, n_beams, 2))), axis=2)
    labels = np.zeros((n_scans, n_beams), dtype=np.int64)
    labels[rng.uniform(size=labels.shape) < 0.2] = -1
    root = rng.normal(size=(n_scans, 6, 6)) * 0.01
    roots = _pose_error.roots(root @ root.transpose(0, 2, 1))
    origins, variance = rng.normal(size=(n_scans, 3)), np.full((n_scans, n_beams, 1), 1e-4)
    used = points[labels >= 0]
    frame = fit_plane(used, sigma=0.01).frame
    local = (used - frame[:3, 3]) @ frame[:3, :3]
    spread = 1e4 * np.array([len(used), (local[:, 0] ** 2).sum(), (local[:, 1] ** 2).sum()])
    total, running, anchor = np.zeros((1, 4, 4)), np.zeros((1, 6, 4)), np.array([[0.3, -0.2, 0.1]])
    plane = np.array([[1.0, 0.0, 0.0, 1.0]])
    for part in (slice(None, 5), slice(5, None)):
        grid, errors = (points[part], variance[part], labels[part]), (roots[part], origins[part], decay)
        _pose_error.accumulate(grid, (plane, anchor), errors, total, running)
    got = _pose_error.covariance_of(frame, spread, anchor[0], total[0])
    h = np.column_stack((np.ones(len(local)), -local[:, 0], local[:, 1]))
    scan, gains = np.repeat(np.arange(n_scans), n_beams)[labels.ravel() >= 0], []
    for s in range(n_scans):
        rows, p = np.zeros((len(used), 6)), used[scan == s] - origins[s]
        rows[scan == s, 0] = 1.0
        rows[scan == s, 3:] = np.column_stack([np.cross(axis, p)[:, 0] for axis in np.eye(3)[::-1]])
        gains.append(np.linalg.lstsq(h, rows, rcond=None)[0] @ roots[s])
    rho = decay ** np.abs(np.subtract.outer(np.arange(n_scans), np.arange(n_scans)))
    want = sum(rho[s, t] * gains[s] @ gains[t].T for s in range(n_scans) for t in range(n_scans))
    np.testing.assert_allclose(got, want, rtol=1e-8, atol=1e-14)


def test_merged_sums_are_those_of_the_union():
    rng = np.random.default_rng(5)
    shift = rng.normal(size=3)
    a, b = rng.normal(size=(2, 3))
    vector = np.array([1.0, *(shift - b)])
    total, running = _pose_error.merge_sums(a, b, np.outer(vector, vector), np.outer(np.ones(6), vector))
    moved = np.array([1.0, *(shift - a)])
    np.testing.assert_allclose(total, np.outer(moved, moved))
    np.testing.assert_allclose(running, np.outer(np.ones(6), moved))


def test_shared_pose_errors_reach_the_planes():
    scans = corridor(40, 6)
    pose = np.diag([0.0, 1e-4, 0.0, 0.0, 0.0, 0.0])
    plain = build(scans).planes
    shared = build(scans, replace(SMALL, pose_correlation_scans=1e9), pose_covariance=pose).planes
    for plane in plain:
        other = max(shared, key=lambda q: q.normal @ plane.normal)
        sideways = abs(plane.normal[1]) > 0.5
        added = other.covariance[0, 0] - plane.covariance[0, 0]
        assert added == pytest.approx(1e-4 if sideways else 0.0, rel=0.02, abs=2e-7)


def test_planes_of_slanted_beams_err_as_their_covariance_says():
    values = []
    for seed in range(15):
        points, covariances, eyes, side = corridor(100, 20 + seed, sigma=0.03)
        for plane in build((points, covariances, eyes, side)).planes:
            k = int(np.argmax(NORMALS @ plane.normal))
            values.append(plane.mahalanobis(Plane.from_hesse(NORMALS[k], DISTANCES[k], np.zeros((3, 3)))))
    assert len(values) == 45
    assert_mean_in_band(values, 3, 0.998)


def slanted_wall(seed, scale=1.0):
    """A wall at x = 2 swept by beams at some 55 degrees to its normal, with noise of `scale` times what is stated."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(0.85, 1.1, 2000), rng.uniform(-0.1, 0.4, 2000)
    u = np.column_stack((np.cos(azimuth), np.sin(azimuth), np.tan(elevation)))
    u /= np.linalg.norm(u, axis=1)[:, None]
    points = u * (2.0 / u[:, 0] + 0.05 * scale * rng.standard_normal(2000))[:, None]
    return points, beam_covariances(u, 0.05)


def sums_of(points, covariances):
    """Moments and noise of points of the plane x = 2, weighted along its true normal."""
    plane, row, noise = np.array([[1.0, 0.0, 0.0, 2.0]]), np.zeros(11), np.zeros((1, 6))
    points_row(points, 1.0 / covariances[:, 0, 0], row)
    flat = np.ascontiguousarray(covariances.reshape(1, -1, 9))
    _own_noise.add_noise(flat, np.zeros((1, len(points)), dtype=np.int64), plane, noise)
    return row, noise[0]


def test_noise_taken_out_of_moments_gives_the_plane_of_maximum_likelihood():
    for seed in range(5):
        points, covariances = slanted_wall(seed)
        row, noise = sums_of(points, covariances)
        frame, spread, covariance = _own_noise.unbiased_frame(row, noise, np.zeros(3))
        likely = fit_plane(points, covariances, viewpoint=np.zeros(3))
        step = np.linalg.inv(likely.frame) @ frame
        sigmas = np.sqrt(np.diag(likely.covariance))
        assert abs(step[2, 3] / sigmas[0]) < 0.5
        assert (np.abs(step[:2, 2] / sigmas[1:]) < 0.5).all()
        np.testing.assert_allclose(np.diag(covariance), np.diag(likely.covariance), rtol=0.15)
        np.testing.assert_allclose(1.0 / spread, np.diag(covariance), rtol=0.15)


def test_noise_stated_too_large_does_not_turn_the_plane_the_other_way():
    points, covariances = slanted_wall(9, scale=0.0)
    frame, _, covariance = _own_noise.unbiased_frame(*sums_of(points, covariances), np.zeros(3))
    np.testing.assert_allclose(frame[:3, 2], [-1.0, 0.0, 0.0], atol=1e-9)
    assert (np.linalg.eigvalsh(covariance) > 0.0).all()


def test_a_joined_region_keeps_the_noise_of_both():
    table = RegionTable(MapperConfig())
    points, covariances = slanted_wall(3)
    rows, noises = zip(*(sums_of(points[k::2], covariances[k::2]) for k in range(2)), strict=True)
    table.add(np.array(rows), np.zeros((2, 2)), np.zeros(2, dtype=np.int64))
    table.fit[:2], table.noise[:2] = rows, noises
    table.join(0, 1)
    whole, noise = sums_of(points, covariances)
    np.testing.assert_allclose(table.fit[0], whole)
    np.testing.assert_allclose(table.noise[0], noise)


def test_the_table_of_regions_is_not_copied_at_every_addition():
    """However long a mission: room is made for twice as many regions, and seldom."""
    table, columns = RegionTable(MapperConfig()), []
    for _ in range(1000):
        table.add(np.zeros((1, 11)), np.zeros((1, 2)), np.zeros(1, dtype=np.int64))
        if not columns or columns[-1] is not table.estimate:
            columns.append(table.estimate)
    assert table.n_regions == 1000 and len(columns) < 12
