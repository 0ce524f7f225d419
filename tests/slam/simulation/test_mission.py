"""The statistics of simulated missions are those their rig states; truth, labels and files are right."""

import json

import numpy as np
import pytest
from scipy.stats import kstest

from slam.errors import LogError
from slam.frontend.deskewing import Sweeps
from slam.frontend.odometry import OdometryTrack
from slam.geometry.frames import lift
from slam.io.load import load
from slam.sensors.log import CloudScan, OdometryReading
from slam.sensors.rig import LocalisationNoise, Rig, Sensor
from slam.sensors.wheel_noise import OdometryNoise
from slam.simulation import HORIZONTAL, SPINNING, VERTICAL, Path, Truth, paper_rig, simulate_mission, spinning_rig
from slam.simulation.record import drifting_odometry, localised_poses, noisy_ranges, relative_motions
from spplanes.registration import beam_directions
from tests.slam.beams import beam_errors
from tests.slam.scenes import assert_same_events, with_sensors
from tests.statistics import assert_mean_in_band, nees


@pytest.fixture(scope="module")
def mission():
    return simulate_mission("corridor", n_scans=300, seed=4)


@pytest.mark.parametrize("sensor", [HORIZONTAL, VERTICAL])
def test_range_noise_is_15_mm_white_and_gaussian(mission, sensor):
    errors = beam_errors(mission, sensor).range_m
    sigma, n = mission.rig.sensors[sensor].range_sigma_m, errors.size
    assert sigma == 0.015 and n > 20_000
    assert_mean_in_band((errors / sigma) ** 2, 1)
    assert abs(errors.mean()) < 3.0 * sigma / np.sqrt(n)
    assert abs(np.corrcoef(errors[:-1], errors[1:])[0, 1]) < 4.0 / np.sqrt(n)
    assert kstest(errors / sigma, "norm").pvalue > 0.005


def test_equal_arguments_give_equal_missions_bit_for_bit_and_a_shorter_one_is_the_beginning_of_a_longer(mission):
    assert_same_events(mission.log.events, simulate_mission("corridor", n_scans=300, seed=4).log.events)
    other = simulate_mission("corridor", n_scans=300, seed=5)
    assert not np.array_equal(other.arrays(VERTICAL).ranges, mission.arrays(VERTICAL).ranges)
    short = simulate_mission("corridor", n_scans=40, seed=4).log.events
    assert_same_events(short, mission.log.events[: len(short)])


def test_events_are_in_time_order_and_scans_have_odometry_at_their_time(mission):
    stamps = [event.stamp_ns for event in mission.log.events]
    assert stamps == sorted(stamps)
    readings = {reading.stamp_ns for reading in mission.log.odometry}
    assert all(scan.stamp_ns in readings for scan in mission.log.scans())
    np.testing.assert_array_equal(mission.log.odometry[0].odom_T_body, np.eye(4))
    np.testing.assert_array_equal(mission.truth.world_T_body[0], np.eye(4))


NOISY = OdometryNoise(slip_sigma_m_per_sqrt_rad=0.01)
UNCALIBRATED = OdometryNoise(scale_sigma=0.03, curvature_sigma_rad_per_m=0.02)


@pytest.mark.parametrize("noise", [NOISY, UNCALIBRATED])
@pytest.mark.parametrize("scale", [1, 20])
def test_odometry_errs_as_the_noise_model_says(noise, scale):
    """NEES of the motion over a curved way, for one covariance of the whole chain and steps of any length."""
    path = Path.rounded([(0.0, 0.0), (2.0, 0.0), (2.0, 2.0), (4.0, 2.0)], 0.8)
    true, rng = path.at(np.linspace(0.0, path.length_m, 8 * scale + 1)), np.random.default_rng(11)
    errors = np.array([drifting_odometry(true, noise, rng)[-1] - true[-1] for _ in range(600)])
    _, covariance = noise.accumulate(relative_motions(true))
    assert_mean_in_band(nees(errors, np.tile(covariance, (len(errors), 1, 1))), 3, level=0.999)


@pytest.mark.parametrize("rig", [paper_rig(), spinning_rig()], ids=["paper", "spinning"])
def test_a_rig_states_no_motion_off_the_floor_that_is_not_simulated(mission, rig: Rig):
    """What is stated and not there makes every covariance larger than the error: of leans by a quarter at 1 mrad."""
    poses, stated = mission.truth.world_T_body, rig.odometry
    assert np.ptp(poses[:, 2, 3]) == 0.0
    np.testing.assert_allclose(poses[:, 2, :3], np.tile([0.0, 0.0, 1.0], (len(poses), 1)), atol=1e-12)
    assert max(stated.z_sigma_m, stated.pitch_sigma_rad, stated.roll_sigma_rad) <= 1e-4


def test_localisation_errs_below_a_centimetre_and_is_correlated_along_the_way():
    noise, way = LocalisationNoise(), np.arange(200_000) * 0.027
    errors = localised_poses(np.zeros((way.size, 3)), way, noise, np.random.default_rng(2))
    independent = errors[:: int(4.0 * noise.correlation_length_m / 0.027)]
    assert_mean_in_band(nees(independent, np.tile(noise.covariance(), (len(independent), 1, 1))), 3, level=0.999)
    assert (np.hypot(errors[:, 0], errors[:, 1]) < 0.01).mean() > 0.99
    lag = round(noise.correlation_length_m / 0.027)
    for column in errors.T:
        assert np.corrcoef(column[:-lag], column[lag:])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.08)


def test_a_sensor_quantises_and_loses_what_is_too_near_or_too_far():
    sensor = Sensor(kind="line", range_sigma_m=1e-9, quantisation_m=0.01, range_min_m=0.3, range_max_m=8.0)
    read = noisy_ranges(np.array([1.2345, 7.994, 7.996, 12.0, np.inf, 0.2]), sensor, np.random.default_rng(0))
    np.testing.assert_allclose(read[:2], [1.23, 7.99], atol=1e-12)
    assert np.isnan(read[2:]).all() and sensor.range_variance_m2 == pytest.approx(1e-18 + 0.01**2 / 12.0)


def test_the_office_ring_closes_and_drifts():
    short = simulate_mission("office", seed=1, spacing_m=0.2)
    positions = short.truth.world_T_body[:, :2, 3]
    assert 79.0 < np.linalg.norm(np.diff(positions, axis=0), axis=1).sum() < 82.0
    np.testing.assert_allclose(positions[-1], [2.0, 0.0], atol=0.2)
    odometry = np.array([reading.odom_T_body[:2, 3] for reading in short.log.odometry])
    assert np.linalg.norm(odometry - positions, axis=1).max() > 0.5
    two = simulate_mission("office", seed=1, spacing_m=0.2, laps=2)
    assert len(two.log.scans(VERTICAL)) > 1.9 * len(short.log.scans(VERTICAL))
    seen = beam_errors(short, VERTICAL)
    assert seen.range_m.std() == pytest.approx(0.015, rel=0.02) and len(np.unique(seen.labels)) > 60


def test_the_hall_gives_organised_clouds_with_labels():
    mission = simulate_mission("hall", n_scans=5, seed=2)
    scans = mission.log.scans(SPINNING)
    assert len(scans) == 5 and all(isinstance(scan, CloudScan) for scan in scans)
    assert mission.truth.labels[SPINNING].shape == (5, *scans[0].points.shape[:2])
    assert_mean_in_band((beam_errors(mission, SPINNING).range_m / 0.015) ** 2, 1, level=0.998)


@pytest.mark.parametrize(
    ("world", "n_scans", "names"),
    [("corridor", 30, "log.clf.gz rig.yaml truth"), ("hall", 3, "clouds odometry.tum rig.yaml times.txt truth")],
)
def test_a_mission_on_disk_is_the_same_mission(world, n_scans, names, tmp_path):
    mission = simulate_mission(world, n_scans=n_scans, seed=6)
    folder = tmp_path / "mission with spaces ü"
    mission.save(folder)
    assert sorted(path.name for path in folder.iterdir()) == names.split()
    assert sorted(path.name for path in (folder / "truth").iterdir()) == ["labels.npz", "planes.json", "trajectory.tum"]
    log, rig = load(folder)
    assert rig == mission.rig
    assert_same_events(mission.log.events, log.events, atol=1e-14)
    assert all((scan.world_T_body is None) == (world == "hall") for scan in log.scans())
    truth = Truth.read(folder / "truth")
    np.testing.assert_array_equal(truth.stamps_ns, mission.truth.stamps_ns)
    np.testing.assert_allclose(truth.world_T_body, mission.truth.world_T_body, atol=1e-14)
    for sensor, labels in mission.truth.labels.items():
        np.testing.assert_array_equal(truth.labels[sensor], labels)
    for a, b in zip(truth.planes, mission.truth.planes, strict=True):
        np.testing.assert_array_equal(a.frame, b.frame)
        assert a.outline.equals(b.outline)
    data = json.loads((folder / "truth" / "planes.json").read_text())
    assert data["format"] == "spplanes/1" and [p["id"] for p in data["planes"]] == list(range(len(truth.planes)))


def test_saving_is_all_or_nothing(tmp_path):
    mission = simulate_mission("room", n_scans=5)
    both = Rig(sensors={**paper_rig().sensors, **spinning_rig().sensors}, odometry=OdometryNoise())
    sentence = "expected scans of one 3D sensor, got those of horizontal, spinning, vertical"
    with pytest.raises(ValueError, match=sentence):
        simulate_mission("hall", n_scans=2, rig=both).save(tmp_path / "cloud")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(ValueError, match="new or an empty folder"):
        mission.save(tmp_path / "mine")
    assert [p.name for p in tmp_path.rglob("*")] == ["mine", "thesis.tex"]
    (tmp_path / "empty").mkdir()
    mission.save(tmp_path / "empty")
    assert (tmp_path / "empty" / "rig.yaml").exists()


def only(name, **sensor):
    return Rig(sensors={name: Sensor(range_sigma_m=0.1, range_max_m=5.0, **sensor)})


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"world": "moon"}, "world: expected one of corridor, office, room, hall, got 'moon'"),
        ({"world": "corridor", "n_scans": 1}, "n_scans: expected at least 2, got 1"),
        ({"world": "corridor", "laps": 2}, "laps: expected 1 in a corridor"),
        ({"world": "office", "laps": 0}, "laps: expected"),
        ({"world": "room", "n_scans": 100_000}, "n_scans: expected at most"),
        ({"world": "room", "spacing_m": 0.0}, "spacing_m: expected a positive"),
        ({"world": "room", "rig": only("sonar", kind="line")}, "rig: expected sensors among"),
        (
            {"world": "room", "rig": only(SPINNING, kind="cloud", bearing_sigma_rad=0.1)},
            "rig: expected bearing noise of",
        ),
    ],
)
def test_missions_that_cannot_be(arguments, sentence):
    with pytest.raises(ValueError, match=sentence):
        simulate_mission(**arguments)


def test_what_is_not_known_and_arcs_that_do_not_fit_are_refused(mission, tmp_path):
    with pytest.raises(ValueError, match="stamps_ns: expected times of scans"):
        mission.truth.poses_at(np.array([17]))
    with pytest.raises(ValueError, match="sensor: expected a 2D laser"):
        mission.arrays("sonar")
    with pytest.raises(LogError, match="cannot be read"):
        Truth.read(tmp_path)
    with pytest.raises(ValueError, match="radius_m: expected arcs that fit"):
        Path.rounded([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)], 1.5)


def test_bearing_noise_is_what_the_rig_says():
    """On a wall at distance d seen under an angle, a bearing error e moves the range by r tan(incidence) e."""
    sigma = 0.002
    rig = with_sensors(paper_rig(), bearing_sigma_rad=sigma, range_sigma_m=1e-9)
    seen = beam_errors(simulate_mission("room", n_scans=200, rig=rig), HORIZONTAL)
    errors, cosine = seen.range_m, seen.cosine
    expected = np.linalg.norm(seen.points, axis=1) * np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) / cosine * sigma
    gentle = (expected > 1e-3) & (expected < 0.02)  # away from normal and from grazing incidence: first order holds
    assert np.mean((errors[gentle] / expected[gentle]) ** 2) == pytest.approx(1.0, abs=0.05)


def test_a_sweep_gives_each_beam_its_own_place():
    rig = with_sensors(paper_rig(), range_sigma_m=1e-9, sweep_s=0.2)
    mission = simulate_mission("room", n_scans=40, rig=rig)
    sensor, arrays, truth = rig.sensors[HORIZONTAL], mission.arrays(HORIZONTAL), mission.truth
    times = sensor.beam_times_ns(5, 720)
    assert times[0] == 5 and times[-1] == 200_000_005 and len(times) == 720
    scan = 2  # on the first straight piece: heading 0, 0.5 m/s
    x = np.interp(sensor.beam_times_ns(int(arrays.stamps_ns[scan]), 720), truth.stamps_ns, truth.world_T_body[:, 0, 3])
    assert x[-1] - x[0] == pytest.approx(0.1, abs=1e-6)
    points = arrays.ranges[scan][:, None] * beam_directions(arrays.angles)
    points = points + np.column_stack([x, 0.0 * x, np.full(720, 0.3)])
    distances = [truth.planes[k].distance(p) for k, p in zip(arrays.labels[scan], points, strict=True) if k >= 0]
    assert len(distances) > 600
    np.testing.assert_allclose(distances, 0.0, atol=1e-6)


def test_a_beam_without_return_has_no_label():
    arrays = simulate_mission("corridor", n_scans=60, rig=with_sensors(paper_rig(), range_max_m=2.0)).arrays(VERTICAL)
    lost = np.isnan(arrays.ranges)
    assert 0.1 < lost.mean() < 0.9 and (arrays.labels[lost] == -1).all() and np.nanmax(arrays.ranges) < 2.0


def test_a_spinning_laser_sees_from_where_it_is_at_each_step():
    rig = with_sensors(spinning_rig(), range_sigma_m=1e-9, sweep_s=0.1)
    mission = simulate_mission("room", n_scans=14, rig=rig)
    truth, sensor = mission.truth, rig.sensors[SPINNING]
    readings = [OdometryReading(int(t), p) for t, p in zip(truth.stamps_ns, truth.world_T_body, strict=True)]
    sweeps = Sweeps(OdometryTrack(readings, rig.odometry), np.zeros((6, 6)))
    (raw, straight), scans = ([], []), [event for event in mission.log.events if isinstance(event, CloudScan)]
    for k in (3, 10):
        world_T_sensor = truth.poses_at(np.array([scans[k].stamp_ns]))[0] @ sensor.body_T_sensor
        begin, labels = scans[k].begin, truth.labels[SPINNING][k]
        assert begin is not None
        at_once = sweeps.unswept(scans[k].points, sensor, scans[k].stamp_ns, begin)
        for points, off in ((scans[k].points, raw), (at_once, straight)):
            for plane in np.unique(labels[labels >= 0]):
                off.append(np.abs(truth.planes[plane].distance(lift(points[labels == plane], world_T_sensor))).max())
    assert max(raw) > 0.02
    assert max(straight) < 0.002
