"""rig.yaml: what it says, what it refuses, the frames it means; the rigs of logs that come with none."""

from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from slam.errors import LogError
from slam.io.default_rigs import assumptions, default_rig_for
from slam.io.load import load
from slam.sensors.log import LaserScan, Log, OdometryReading
from slam.sensors.rig import LocalisationNoise, Mount, Rig, Sensor
from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS
from slam.simulation import VERTICAL, paper_rig, spinning_rig
from tests.spplanes.scenes import spun, to_walls

GOOD = """
sensors:
  front: {kind: line, record: FLASER, range_sigma_m: 0.01, range_max_m: 30.0}
  up:
    kind: slice
    body_T_sensor: {xyz_m: [0.1, 0.2, 0.3], rpy_deg: [0, -90, 0]}
    range_sigma_m: 0.015
    range_max_m: 8.0
odometry: {along_sigma_m_per_sqrt_m: 0.05}
"""


def from_text(tmp_path, text):
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return Rig.from_yaml(path)


def test_a_rig_from_a_file(tmp_path):
    rig = from_text(tmp_path, GOOD)
    assert list(rig.sensors) == ["front", "up"] and list(rig.of_kind("slice")) == ["up"] and rig.of_kind("cloud") == {}
    assert rig.name_of_record("FLASER") == "front" and rig.name_of_record("up") == "up"
    assert rig.name_of_record("ROBOTLASER1") is None
    np.testing.assert_array_equal(rig.sensors["front"].body_T_sensor, np.eye(4))
    assert rig.odometry.along_sigma_m_per_sqrt_m == 0.05 and rig.localisation is None


@pytest.mark.parametrize("rig", [paper_rig(), spinning_rig()])
def test_a_rig_round_trips(tmp_path, rig):
    rig.to_yaml(tmp_path / "r.yaml")
    assert Rig.from_yaml(tmp_path / "r.yaml") == rig


def test_mount_angles():
    rpys_deg = ((90.0, 0.0, 0.0), (0.0, 90.0, 0.0), (0.0, 0.0, 90.0), (90.0, 0.0, 90.0))
    roll, pitch, yaw, both = (Mount(rpy_deg=rpy_deg).as_matrix()[:3, :3] for rpy_deg in rpys_deg)
    up = paper_rig().sensors[VERTICAL].body_T_sensor[:3, :3]  # bearing 0: up; 90 deg: left
    np.testing.assert_array_equal(up @ [[1, 0], [0, 1], [0, 0]], [[0, 0], [0, 1], [1, 0]])
    np.testing.assert_allclose(yaw @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(pitch @ [1, 0, 0], [0, 0, -1], atol=1e-15)
    np.testing.assert_allclose(roll @ [0, 1, 0], [0, 0, 1], atol=1e-15)
    np.testing.assert_allclose(both, yaw @ roll, atol=1e-15)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("record: FLASER", "recrod: FLASER"), "sensors.front.recrod: unknown key, did you mean record?"),
        (("kind: line", "kind: sonar"), "sensors.front.kind: input should be 'line', 'slice' or 'cloud', got 'sonar'"),
        (("range_sigma_m: 0.01,", ""), "sensors.front.range_sigma_m: missing"),
        (("range_sigma_m: 0.015", "range_sigma_m: -1"), "sensors.up.range_sigma_m: input should be greater than 0"),
        (("range_max_m: 8.0", "range_max_m: .nan"), "sensors.up.range_max_m: input should be a finite number"),
        (("[0.1, 0.2, 0.3]", "[0.1, 0.2]"), r"sensors.up.body_T_sensor.xyz_m.2: missing"),
        (("{xyz_m: [0.1, 0.2, 0.3], rpy_deg: [0, -90, 0]}", "[[1, 0], [0, 1]]"), r"body_T_sensor: .*expected shape"),
        (
            ("along_sigma", "allong_sigma"),
            "odometry.allong_sigma_m_per_sqrt_m: unknown key, did you mean along_sigma_m_per_sqrt_m?",
        ),
        (("sensors:\n", "sensors: [\n"), "expected YAML, got a syntax error"),
        ((GOOD, "sensors: {}"), "sensors: dictionary should have at least 1 item"),
        ((GOOD, "[1, 2]"), "expected a mapping of keys to values, got list"),
        ((GOOD, ""), "sensors: missing"),
        ((GOOD, "!!python/object/apply:os.system ['true']"), "expected YAML"),
    ],
)
def test_bad_rigs_name_file_and_key(tmp_path, change, sentence):
    with pytest.raises(LogError, match=sentence) as caught:
        from_text(tmp_path, GOOD.replace(*change))
    assert "rig.yaml" in str(caught.value) and "\n" not in str(caught.value)


def test_missing_and_binary_files(tmp_path):
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    for name, sentence in (("none", "cannot be read"), ("b", "expected text in UTF-8")):
        with pytest.raises(LogError, match=rf"{name}\.yaml: {sentence}"):
            Rig.from_yaml(tmp_path / f"{name}.yaml")


def test_a_mount_is_said_once():
    rows = tuple(map(tuple, np.eye(4).tolist()))
    with pytest.raises(ValidationError, match="got both"):
        Mount(xyz_m=(1.0, 0.0, 0.0), matrix=rows)
    with pytest.raises(ValidationError, match="right-handed rotation"):
        Mount(matrix=tuple(map(tuple, np.diag([1.0, 1.0, -1.0, 1.0]).tolist())))


@pytest.mark.parametrize(("step", "expected"), [(0.01, 0.01), (0.001, 0.001), (None, 0.0)])
def test_the_default_rig_finds_the_step_of_the_ranges(tmp_path, step, expected):
    ranges = np.random.default_rng(0).uniform(0.5, 20.0, 100)
    ranges = ranges if step is None else np.round(ranges / step) * step
    ranges[3] = np.nan
    rig = default_rig_for(Log([LaserScan(0, "FLASER", ranges, np.linspace(-1, 1, 100))], tmp_path))
    sensor = rig.sensors["FLASER"]
    assert sensor.kind == "line" and sensor.quantisation_m == expected
    assert _scatter(sensor) == pytest.approx(0.015)  # no line tells more
    assert rig.odometry == UNCALIBRATED_WHEELS and np.nanmax(ranges) < sensor.range_max_m


@pytest.mark.parametrize("sigma_m", [0.016, 0.03])
def test_a_default_rig_has_beams_that_scatter_as_its_lines_show(tmp_path, sigma_m):
    """What they share of it goes up with it."""
    rng, angles = np.random.default_rng(1), np.linspace(-np.pi / 2, np.pi / 2, 181)
    walls = np.minimum(4.0 / np.maximum(np.cos(angles), 1e-9), 3.0 / np.maximum(np.abs(np.sin(angles)), 1e-9))
    scans = [LaserScan(k, "FLASER", walls + sigma_m * rng.standard_normal(len(angles)), angles) for k in range(24)]
    log = Log(scans, tmp_path)
    rig = default_rig_for(log)
    assert _scatter(rig.sensors["FLASER"]) == pytest.approx(sigma_m, rel=0.06)
    assert rig.sensors["FLASER"].surface_sigma_m == pytest.approx(np.hypot(0.008, 0.5 * sigma_m), rel=0.06)
    assert "mm of noise, as its lines show" in assumptions(log, rig)[0]


def _scatter(sensor: Sensor) -> float:
    """Standard deviation of a beam about a line, m."""
    return float(np.hypot(np.sqrt(sensor.range_variance_m2), sensor.surface_sigma_m))


def test_no_default_rig_without_lasers(tmp_path):
    with pytest.raises(LogError, match="expected laser scans, got none"):
        default_rig_for(Log([OdometryReading(0, np.eye(4))], tmp_path))


def test_localisation_covariance_in_the_order_of_the_spmodel():
    noise = LocalisationNoise(xy_sigma_m=0.002, heading_sigma_rad=0.003)
    np.testing.assert_allclose(np.diag(noise.location_covariance()), [4e-6, 4e-6, 0.0, 9e-6, 0.0, 0.0])
    np.testing.assert_allclose(np.diag(noise.covariance()), [4e-6, 4e-6, 9e-6])


def lines_of_a_room() -> np.ndarray:
    """What an upright laser sees that is turned through 120 lines in a room of 6 x 6 x 2.6 m, in the order it came."""
    rays = spun(np.linspace(-1.4, 1.4, 90), np.linspace(0.0, 3.0, 120)).swapaxes(0, 1).reshape(-1, 3)
    return rays * to_walls(rays, [-3.0, -3.0, -1.3], [3.0, 3.0, 1.3])[:, None]


def tilt_sigma_of(folder: Path) -> float:
    return load(folder)[1].sensors["scanner"].plane_sigma_rad


def test_angles_of_a_turned_laser_are_trusted_less_than_those_of_a_spinning_one(tmp_path: Path):
    points, in_order, mixed = lines_of_a_room(), tmp_path / "lines", tmp_path / "mixed"
    for folder, cloud in ((in_order, points), (mixed, np.random.default_rng(0).permutation(points))):
        folder.mkdir()
        for number in range(2):
            np.save(folder / f"{number}.npy", cloud)
    assert tilt_sigma_of(in_order) > 3.0 * tilt_sigma_of(mixed) > 0.0


def test_a_first_cloud_that_cannot_be_read_does_not_keep_the_others_from_being_used(tmp_path: Path):
    np.save(tmp_path / "0.npy", np.full((100, 3), np.nan))
    np.save(tmp_path / "1.npy", lines_of_a_room())
    assert tilt_sigma_of(tmp_path) > 0.0
