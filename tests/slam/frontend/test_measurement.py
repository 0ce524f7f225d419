"""Planes as measurements: errors of surfaces that neighbours share, steps that averages show, sensors' limits."""

from typing import Any

import gtsam
import numpy as np
import pytest

from benchmarks.corpus.drives.sensing import camera_beams
from slam.config import SlamConfig
from slam.frontend.measurement import for_points, planes_of_cloud, usable_points, usable_ranges
from slam.frontend.scan_regions import Regions, ScanPart, believed_plane, believed_planes, relabelled
from slam.geometry.frames import inverse
from slam.sensors.log import CloudScan
from slam.sensors.rig import Sensor
from slam.sensors.scan_noise import servo_covariances, surface_covariances, tilt_drift
from spplanes import MapperConfig, Plane, fit_plane
from spplanes.segmentation.config import ValidationConfig
from spplanes.segmentation.validation.bends import surest_bend
from spplanes.segmentation.validation.one_plane import InPatches, could_be_seen, fits_its_noise, is_one_plane
from spplanes.segmentation.validation.splitting import LIMIT
from tests.slam.floorplan.measured_suites import Measured
from tests.spplanes.fitting.test_shared_error import wall
from tests.spplanes.scenes import spun, to_walls
from tests.statistics import assert_mean_in_band

RULES = ValidationConfig()
SIGMA = 0.015
ABOVE, FAR_ABOVE = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 9.0])
TRUTH = Plane.from_hesse([0.0, 0.0, 1.0], 0.0, np.zeros((3, 3)))


def sensor(**settings: Any) -> Sensor:
    return Sensor(kind="cloud", **{"range_sigma_m": 0.01, "range_max_m": 20.0, **settings})


def patch(rng: np.random.Generator, count: int = 900, *, x: float = 2.0, y: float = 1.5) -> np.ndarray:
    """Points of z = 0, denser on one side as from a near scanner, with noise, shape (N, 3)."""
    places = np.column_stack((x * rng.beta(1.0, 2.5, count), rng.uniform(0.0, y, count)))
    return np.column_stack((places, SIGMA * rng.standard_normal(count)))


def isotropic(points: np.ndarray) -> np.ndarray:
    return np.tile(SIGMA**2 * np.eye(3), (len(points), 1, 1))


def test_a_fit_with_errors_shared_by_patches_is_consistent_and_without_them_is_not():
    rng, rough = np.random.default_rng(0), sensor(surface_sigma_m=0.02, surface_correlation_m=0.4)
    told, untold, found = [], [], []
    for _ in range(400):
        points = patch(rng)
        first = fit_plane(points, sigma=SIGMA, viewpoint=[0, 0, 1])
        cells = np.floor((points - first.centre) @ first.frame[:3, :2] / 0.4).astype(int)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        points[:, 2] += 0.02 * rng.standard_normal(cell.max() + 1)[cell.ravel()]
        noise = surface_covariances(points, isotropic(points), first.frame, rough)
        told.append(fit_plane(points, noise, viewpoint=[0, 0, 1]).mahalanobis(TRUTH))
        untold.append(fit_plane(points, sigma=SIGMA, viewpoint=[0, 0, 1], shared_error=False).mahalanobis(TRUTH))
        found.append(fit_plane(points, sigma=SIGMA, viewpoint=[0, 0, 1]).mahalanobis(TRUTH))
    assert_mean_in_band(np.array(told), 3)
    assert np.mean(untold) > 30.0 and 0.5 < np.mean(found) < 3.6  # waves longer than a patch are granted, and not there


def test_a_notice_board_of_two_centimetres_is_a_step_and_a_wall_is_none():
    rng = np.random.default_rng(2)
    false_alarms, found = 0, 0
    for _ in range(200):
        points = patch(rng, 3000)
        false_alarms += InPatches(fit_plane(points, sigma=SIGMA), points, isotropic(points), RULES).has_step
        points[points[:, 1] > 0.9, 2] += 0.02
        found += InPatches(fit_plane(points, sigma=SIGMA), points, isotropic(points), RULES).has_step
    assert false_alarms <= 2 and found >= 198


def test_a_floor_with_a_foot_on_it_is_the_floor_without_the_foot():
    rng, chi2, lost = np.random.default_rng(4), [], 0
    for _ in range(200):
        points = patch(rng, 9000, x=8.0, y=6.0)
        foot = (np.abs(points[:, :2] - [0.8, 3.0]) < 0.15).all(axis=1)
        points[foot, 2] += 0.08
        part, plane = as_part(points)
        assert not is_one_plane(plane, points, part.noise, ABOVE, RULES)
        believed = believed_plane(part)
        if believed is None:
            lost += 1
            continue
        assert not np.isin(np.flatnonzero(foot), believed.part.members).any()
        assert believed.plane.n_points == len(believed.part.members)
        chi2.append(believed.plane.mahalanobis(TRUTH))
    assert lost <= 4
    assert_mean_in_band(np.array(chi2), 3)


def test_a_plane_of_which_much_strays_is_none():
    points = patch(np.random.default_rng(5), 3000, x=4.0, y=3.0)
    points[points[:, 1] > 2.7, 2] += 0.06
    part, _ = as_part(points)
    assert believed_plane(part) is None


def regions_of(points: np.ndarray, labels: np.ndarray, frames: np.ndarray, **told: Any) -> Regions:
    """Of a grid of points (S, B, 3) that scatter alike in all directions, seen from far above."""
    noise, others = isotropic(labels.ravel()).reshape(*labels.shape, 3, 3), {"viewpoint": FAR_ABOVE, "rules": RULES}
    given = {"covariances": noise, "sensor": sensor(), "mapper": MapperConfig(), **others, **told}
    return Regions(points, labels=labels, frames=frames, **given)


def as_part(points: np.ndarray) -> tuple[ScanPart, Plane]:
    """Points as a region of a grid, with the plane fitted to them."""
    plane, labels = fit_plane(points, sigma=SIGMA, viewpoint=[0, 0, 1]), np.zeros((30, len(points) // 30), dtype=int)
    regions = regions_of(points.reshape(*labels.shape, 3), labels, plane.frame[None], viewpoint=ABOVE)
    return ScanPart(regions, np.arange(len(points)), plane.frame), plane


def test_what_a_scan_shares_and_a_slow_drift_of_the_sensor_are_no_steps():
    rng = np.random.default_rng(3)
    points, drifted = patch(rng), patch(np.random.default_rng(4))
    scan = np.floor(points[:, 0] / 0.1).astype(int)
    points[:, 2] += 0.02 * rng.standard_normal(scan.max() + 1)[scan]
    drifted[:, 2] += 0.03 * np.sin(4.0 * drifted[:, 0])
    for some, told in ((points, {"scan_index": scan}), (drifted, {"drift_m": np.full(len(drifted), 0.02)})):
        given = fit_plane(some, sigma=SIGMA), some, isotropic(some), RULES
        assert InPatches(*given).has_step and not InPatches(*given, **told).has_step


def test_chi2_far_beyond_the_noise_and_planes_seen_edge_on_are_refused():
    points = patch(np.random.default_rng(5))
    plane = fit_plane(points, sigma=SIGMA, viewpoint=[0.0, 0.0, 2.0])
    assert fits_its_noise(plane, RULES) and not fits_its_noise(fit_plane(points, sigma=0.7 * SIGMA), RULES)
    assert could_be_seen(plane, np.array([0.5, 0.5, 2.0]), RULES)
    assert not could_be_seen(plane, np.array([9.0, 0.5, 0.05]), RULES)
    assert is_one_plane(plane, points, isotropic(points), np.array([0.5, 0.5, 2.0]), RULES)


def test_the_servos_error_grows_with_the_lever_and_spares_side_walls():
    tilting = sensor(tilt_sigma_rad=0.02)
    floor = Plane.from_hesse([0.0, 0.0, 1.0], -0.5, np.zeros((3, 3)))
    np.testing.assert_allclose(tilt_drift(floor, np.array([[3.0, 1.0, -0.5]]), tilting), [0.06])
    side = Plane.from_hesse([0.0, 1.0, 0.0], -1.0, np.zeros((3, 3)))
    np.testing.assert_allclose(tilt_drift(side, np.array([[3.0, -1.0, 0.7]]), tilting), [0.0])


def test_lines_of_a_tilting_scanner_share_the_servos_error_block_by_block():
    """A floor of 40 lines, tilted by blocks of 10: the plane's error is within its covariance, and of its size.

    Points that share an error are counted as that many worse ones; what they say of slopes inside a block is lost.
    """
    tilting = sensor(tilt_sigma_rad=0.01, tilt_correlation_lines=10)
    rng, truth = np.random.default_rng(8), Plane.from_hesse([0.0, 0.0, 1.0], -0.5, np.zeros((3, 3)))
    x, y = np.meshgrid(np.linspace(0.8, 3.0, 40), np.linspace(-1.0, 1.0, 21), indexing="ij")
    floor, line = np.stack((x, y, np.full_like(x, -0.5)), axis=2), np.repeat(np.arange(40), 21)
    nees = []
    for _ in range(400):
        turn = np.repeat(0.01 * rng.standard_normal(4), 10)[:, None, None] * np.array([0.0, 1.0, 0.0])
        points = (floor + np.cross(turn, floor)).reshape(-1, 3) + SIGMA * rng.standard_normal((len(line), 3))
        noise = servo_covariances(points, isotropic(points), line, tilting)
        nees.append(fit_plane(points, noise, viewpoint=np.zeros(3)).mahalanobis(truth))
    assert 1.0 < np.mean(nees) < 3.0


def test_rough_fronts_are_found_where_the_rig_knows_of_them():
    """A wall and, beside it, a hedge whose leaves are 25 mm deep."""
    rng = np.random.default_rng(4)
    z, x = np.meshgrid(np.linspace(-1.0, 1.0, 60), np.linspace(0.5, 3.5, 90), indexing="ij")
    depth = np.where(x < 2.0, 2.0, 2.5 + 0.025 * rng.standard_normal(x.shape))
    points = np.stack((x, depth, z), axis=2) + 0.004 * rng.standard_normal((60, 90, 3))
    scan, seen = CloudScan(0, "scanner", points), []
    for rough_sigma_m in (0.0, 0.06):
        rig = sensor(range_sigma_m=0.004, surface_sigma_m=0.005, rough_sigma_m=rough_sigma_m)
        planes = [one.plane for one in planes_of_cloud(scan, rig, SlamConfig())]
        seen.append(sum(one.n_points for one in planes if abs(one.d + 2.5) < 0.05))
    assert seen[1] > 2000 > seen[0]


@pytest.mark.parametrize("stated", [{}, {"rows": 32, "columns": 720}], ids=["found", "stated"])
def test_a_scan_without_order_is_arranged(stated: dict[str, int]):
    """A room of 8 x 6 x 2.7 m seen by a spinning lidar of 32 rings, points shuffled."""
    rng = np.random.default_rng(0)
    rays = spun(np.linspace(0.5, -0.5, 32), 2.0 * np.pi * np.arange(720) / 720).reshape(-1, 3)
    ranges = to_walls(rays, [-3.0, -2.5, -1.2], [5.0, 3.5, 1.5])
    points = rays * (ranges + 0.005 * rng.standard_normal(len(ranges)))[:, None]
    points[rng.choice(len(points), 300, replace=False)] = np.nan
    cloud = CloudScan(0, "lidar", rng.permutation(points))
    seen = planes_of_cloud(cloud, sensor(range_sigma_m=0.005, **stated), SlamConfig())
    walls = [(1, 0, 0, -3.0), (-1, 0, 0, -5.0), (0, 1, 0, -2.5), (0, -1, 0, -3.5), (0, 0, 1, -1.2), (0, 0, -1, -1.5)]
    for *normal, d in walls:
        plane = next(one.plane for one in seen if one.plane.normal @ normal > 0.99)  # the largest comes first
        assert plane.normal @ normal > np.cos(0.001) and plane.d == pytest.approx(d, abs=0.001)
    assert sum(one.n_points for one in seen) > 0.9 * 32 * 720


def test_scans_without_a_return_have_no_planes():
    none = np.empty((0, 3)), np.full((40, 3), np.nan), np.full((4, 9, 3), np.nan), np.full((5, 3), 1e3), np.ones((1, 3))
    for points in none:
        assert planes_of_cloud(CloudScan(0, "lidar", points), sensor(), SlamConfig()) == []


def test_ranges_outside_the_limits_are_no_returns():
    limited = sensor(range_min_m=0.5)
    ranges, lost = np.array([0.4, 0.6, 19.0, 20.0, np.nan, np.inf]), [True, False, False, True, True, True]
    np.testing.assert_array_equal(np.isnan(usable_ranges(ranges, limited)), lost)
    points = usable_points(np.array([[0.3, 0.0, 0.0], [3.0, 0.0, 0.0]]), limited)
    assert np.isnan(points[0]).all() and np.isfinite(points[1]).all()


@pytest.mark.parametrize(("apart_m", "cell_m"), [(0.02, 0.05), (0.16, 0.08), (3.0, 0.1)])
def test_outlines_are_as_fine_as_rows_of_points_lie_apart(apart_m: float, cell_m: float):
    row, column = np.meshgrid(np.arange(20.0), np.arange(30.0), indexing="ij")
    points = np.stack((np.full_like(row, 4.0), 0.01 * column, apart_m * row), axis=2)
    points[3:5, :7] = np.nan
    assert for_points(MapperConfig(outline_cell_m=0.05), points).outline_cell_m == pytest.approx(cell_m)
    assert for_points(MapperConfig(outline_cell_m=0.05), np.full((4, 9, 3), np.nan)).outline_cell_m == 0.05


def test_the_planes_of_a_grid_are_those_of_their_points_alone_and_a_line_is_none():
    rng = np.random.default_rng(13)
    points = np.concatenate((patch(rng), patch(rng) + np.array([0.0, 0.0, 1.0]))).reshape(20, -1, 3)
    labels = np.repeat([2, 0], 10)[:, None] * np.ones(points.shape[1], dtype=np.int64)
    labels[3, :7], labels[4, :9] = -1, 1
    points[4, :9] = np.linspace(0.0, 1.0, 9)[:, None] * np.array([1.0, 0.0, 0.0])
    regions = regions_of(points, labels, np.tile(np.eye(4), (3, 1, 1)))
    noise, found = regions.covariances, believed_planes(regions)
    assert found[1] == []
    for k in (0, 2):
        alone, (measured,) = fit_plane(points[labels == k], noise[labels == k], viewpoint=FAR_ABOVE), found[k]
        assert len(measured.part.members) == np.count_nonzero(labels == k)
        np.testing.assert_array_equal(measured.plane.frame, alone.frame)
        np.testing.assert_array_equal(measured.plane.covariance, alone.covariance)


def test_what_residuals_show_beyond_the_rig_is_in_the_covariance():
    """Walls that wander by 2 mm an octave, of which the rig says nothing: the mean chi2 of a tilt is 90 without it."""
    rng, tilts = np.random.default_rng(14), []
    patient = ValidationConfig(step_m=1.0, misfit_sigmas=1e3)
    for _ in range(20):
        points = np.concatenate([wall(0.002, rng) - (0.0, 0.0, k) for k in range(4)]).reshape(40, -1, 3)
        labels = np.repeat(np.arange(4), 10)[:, None] * np.ones(points.shape[1], dtype=np.int64)
        noise = np.tile(0.005**2 * np.eye(3), (*labels.shape, 1, 1))
        rough = np.array([Plane.from_hesse([0.0, 0.0, 1.0], -float(k), np.zeros((3, 3))).frame for k in range(4)])
        for (one,) in believed_planes(regions_of(points, labels, rough, covariances=noise, rules=patient)):
            slope = one.plane.frame[:3, :3].T @ (0.0, 0.0, 1.0)
            tilts.append(slope[:2] ** 2 / np.diagonal(one.plane.covariance)[1:])
    assert 0.5 < np.mean(tilts) < 1.5  # 160 tilts: a standard deviation of 0.11, and planes of a scan share an estimate


def test_a_wall_that_reaches_beyond_the_sensors_range_is_where_it_is():
    """Of its far end those returns are left that err to this side: 3 dof, over walls from 4.3 m to beyond the 5 m."""
    rng, rays = np.random.default_rng(11), camera_beams(60, 80, 72.5).directions
    camera = sensor(range_sigma_m=0.0015, disparity_sigma_per_m=0.0014, range_min_m=0.3, range_max_m=5.0)
    nees, pieces = [], 0
    for _ in range(60):
        tilt, d = rng.uniform(0.2, 0.5), rng.uniform(4.1, 4.5)
        normal = np.array((np.sin(tilt), 0.0, -np.cos(tilt)))  # toward the camera
        ranges = -d * np.cos(tilt) / (rays @ normal)
        read = ranges + np.sqrt(camera.range_variance_at(ranges)) * rng.standard_normal(ranges.shape)
        seen = planes_of_cloud(CloudScan(0, "camera", rays * read[..., None]), camera, SlamConfig())
        pieces += len(seen)
        nees.append(seen[0].plane.mahalanobis(Plane.from_hesse(normal, -d * np.cos(tilt), np.zeros((3, 3)))))
    assert_mean_in_band(np.array(nees), 3)
    assert pieces <= 61  # one wall in a thousand seems bent


@pytest.mark.parametrize("corner_deg, heading_deg", [(2.5, 130.0), (3.0, 205.0)])
def test_what_runs_round_a_blunt_corner_is_the_walls_on_either_side(corner_deg: float, heading_deg: float):
    """A strip of a wall and twice as much of the next, 5 mm off the plane through both, in noise of 15 mm."""
    rng, grid = np.random.default_rng(15), (30, 30)
    turn, slope = gtsam.Rot3.Yaw(np.radians(heading_deg)).matrix(), np.tan(np.radians(corner_deg))
    leaning = np.array((-slope, 0.0, 1.0)) / np.hypot(slope, 1.0)
    walls = [Plane.from_hesse(turn @ one, 0.0, np.zeros((3, 3))) for one in (leaning, (0.0, 0.0, 1.0))]
    whole, nees = [], []
    for _ in range(60):
        places = rng.uniform((-0.35, -1.2), (0.7, 1.2), (900, 2))
        height = slope * np.maximum(places[:, 0], 0.0) + SIGMA * rng.standard_normal(900)
        points = np.column_stack((places, height)) @ turn.T
        labels = np.zeros(grid, dtype=np.int64)
        regions = regions_of(points.reshape(*grid, 3), labels, np.eye(4)[None])
        (sides,) = believed_planes(regions)
        if len(sides) < 2:  # most others are steeper to the eye, and no plane
            continue
        numbers, of = np.unique(relabelled(regions, labels, [sides])[0], return_counts=True)
        assert numbers.tolist() == [-1, 0, 1] and of[1:].tolist() == [len(one.part.points) for one in sides]
        fit = fit_plane(points, sigma=SIGMA, viewpoint=FAR_ABOVE, shared_error=False)
        whole.append(min(fit.mahalanobis(one) for one in walls))
        nees += [min(one.plane.mahalanobis(other) for other in walls) for one in sides]
    assert len(whole) >= 20 and np.mean(whole) > 30.0
    assert_mean_in_band(np.array(nees), 3, 0.999)


def test_flat_walls_have_no_bend():
    rng, bends = np.random.default_rng(16), []
    for _ in range(1500):
        places = rng.uniform(-1.0, 1.0, (rng.integers(100, 1000), 2)) * (1.5, 0.4)
        design, residuals = np.column_stack((np.ones(len(places)), places)), SIGMA * rng.standard_normal(len(places))
        residuals -= design @ np.linalg.lstsq(design, residuals, rcond=None)[0]
        bend = surest_bend(places, residuals, np.full(len(places), SIGMA**-2.0))
        assert bend is not None
        bends.append(bend.chi2)
    assert np.mean(np.array(bends) > LIMIT) < 3e-3  # one in a thousand, and three standard deviations
    assert 12.0 < np.quantile(bends, 0.99) < LIMIT  # the limit is as near as that allows


def test_planes_of_a_spinning_laser_are_as_sure_as_they_say():
    """With returns that may be of another surface the mean is 3.5; two strips taken for one plane count as 30."""
    found = []
    for seed in range(2):
        measured = Measured.of(seed, range_sigma_m=SIGMA, spacing_m=0.8, rooms_a_side=1)
        for frame in measured.keyframes:
            body_T_world = inverse(measured.truth.poses_at(np.array([frame.stamp_ns]))[0])
            true = [plane.transform(body_T_world) for plane in measured.truth.planes]
            for plane in (seen.plane for seen in frame.observations):
                alike = [one for one in true if one.normal @ plane.normal > 0.99]
                nearest = min(alike, key=lambda one, at=plane.centre: abs(float(one.distance(at))), default=None)
                found.append(30.0 if nearest is None else min(plane.mahalanobis(nearest), 30.0))
    assert len(found) > 500
    assert_mean_in_band(np.array(found), 3)
