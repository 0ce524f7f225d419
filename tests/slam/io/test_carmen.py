"""CARMEN logs: what they hold, what is wrong with bad ones, and that what we write reads back."""

import errno
import gzip
import io

import numpy as np
import pytest

from slam import lazy
from slam.errors import LogError
from slam.geometry.frames import planar_transform
from slam.io.carmen import read_carmen, write_carmen
from slam.io.default_rigs import default_rig_for
from slam.sensors.log import CloudScan, LaserScan, Log, OdometryReading
from slam.sensors.rig import Mount, Rig, Sensor
from slam.session._codec import encode
from tests.slam.real_data import needs
from tests.slam.scenes import assert_same_events


def flaser(t, x=0.0, ranges="1.0 2.0 81.83", laser=None):
    n = len(ranges.split())
    pose = f"{x} 0 0" if laser is None else laser
    return f"FLASER {n} {ranges} {pose} {x} 0 0 {t} host {t}\n"


def robotlaser(t, k=1, ranges="1.0 2.0", start=-1.0, step=0.5, far=80.0, laser="0.1 0 0", robot="0 0 0"):
    n = len(ranges.split())
    return f"ROBOTLASER{k} 0 {start} 1.0 {step} {far} 0.01 0 {n} {ranges} 0 {laser} {robot} 0 0 0 0 0 {t} host {t}\n"


def odom(t, x=0.0):
    return f"ODOM {x} 0 0 0 0 0 {t} host {t}\n"


def write(tmp_path, *lines, name="test.clf"):
    path = tmp_path / name
    data = "".join(lines).encode()
    path.write_bytes(gzip.compress(data) if name.endswith(".gz") or "packed" in name else data)
    return path


@pytest.mark.parametrize("name", ["plain.clf", "packed.clf.gz", "packed without suffix"])
def test_scans_and_odometry_of_flaser(tmp_path, name):
    lines = ["# comment\n", "PARAM robot_length 1 0 host 0\n", "\n", flaser(10.5, x=1.0), flaser("11.123456789", x=2.0)]
    path = write(tmp_path, *lines, name=name)
    log = read_carmen(path)
    scans = log.scans("FLASER")
    assert [event.stamp_ns for event in log.events] == [10_500_000_000] * 2 + [11_123_456_789] * 2
    assert [isinstance(event, OdometryReading) for event in log.events] == [True, False] * 2
    np.testing.assert_array_equal(scans[0].ranges, [1.0, 2.0, np.nan])
    np.testing.assert_allclose(scans[0].angles, [-np.pi / 2, 0.0, np.pi / 2])
    np.testing.assert_allclose(log.odometry[1].odom_T_body, planar_transform(2.0, 0.0, 0.0))
    assert log.source == path and log.notes == ["skipped 1 PARAM records"]


@pytest.mark.parametrize(("n", "first", "last"), [(180, -90, 89), (181, -90, 90), (361, -90, 90), (360, -90, 89.5)])
def test_bearings_of_a_sick(tmp_path, n, first, last):
    angles = np.rad2deg(read_carmen(write(tmp_path, flaser(1.0, ranges=" ".join(["1.0"] * n)))).scans()[0].angles)
    np.testing.assert_allclose(angles, np.linspace(first, last, n), atol=1e-9)


@pytest.mark.parametrize(
    ("line", "ranges"),
    [
        (flaser(1.0, ranges="nan inf 0 -1 7.94 7.95 8.19 1.0"), [np.nan] * 4 + [7.94, np.nan, np.nan, 1.0]),  # of 8 m
        (flaser(1.0, ranges="39.9 40.0 81.83"), [39.9, np.nan, np.nan]),
        (flaser(1.0, ranges="39.9 45.0 50.0"), [39.9, 45.0, 50.0]),
        (robotlaser(1.0, ranges="4.9 5.0", far=5.0), [4.9, np.nan]),
    ],
)
def test_no_returns(tmp_path, line, ranges):
    """In the mode of 8 m 8.19 is an error code."""
    np.testing.assert_array_equal(read_carmen(write(tmp_path, line)).scans()[0].ranges, ranges)


def test_robotlaser_states_its_bearings_and_poses(tmp_path):
    log = read_carmen(write(tmp_path, robotlaser(1.0, robot="3 4 1.5"), odom(0.5, x=9.0), odom(1.5, x=9.5)))
    scan = log.scans("ROBOTLASER1")[0]
    np.testing.assert_allclose(scan.angles, [-1.0, -0.5])
    np.testing.assert_allclose(scan.world_T_body, planar_transform(3.0, 4.0, 1.5))
    assert [reading.odom_T_body[0, 3] for reading in log.odometry] == [9.0, 9.5]  # ODOM where there is ODOM
    alone = read_carmen(write(tmp_path, robotlaser(1.0, robot="3 4 1.5")))
    np.testing.assert_allclose(alone.odometry[0].odom_T_body, planar_transform(3.0, 4.0, 1.5))


def test_rawlaser_and_remissions(tmp_path):
    raw = "RAWLASER1 0 -1.5 3.0 1.5 80 0.01 0 3 1 2 3 3 7 8 9 1.0 host 1.0\n"
    log = read_carmen(write(tmp_path, raw, odom(1.0)))
    np.testing.assert_array_equal(log.scans()[0].ranges, [1.0, 2.0, 3.0])
    assert log.scans()[0].world_T_body is None
    assert [isinstance(event, OdometryReading) for event in log.events] == [True, False]


def test_the_log_tells_mounts(tmp_path):
    moved = read_carmen(write(tmp_path, flaser(1.0, x=1.0, laser="1.2 0 0"), flaser(2.0, x=2.0, laser="2.2 0 0")))
    np.testing.assert_allclose(moved.mounts["FLASER"], planar_transform(0.2, 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(moved.scans()[0].world_T_body, planar_transform(1.0, 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(default_rig_for(moved).sensors["FLASER"].body_T_sensor, moved.mounts["FLASER"])
    corrected = read_carmen(write(tmp_path, flaser(1.0, x=1.0, laser="1.2 0 0"), flaser(2.0, x=2.0, laser="2.9 0 0")))
    assert corrected.mounts == {}
    stated = "PARAM robot_frontlaser_offset 0.3 0 host 0\n"
    told = read_carmen(write(tmp_path, stated, flaser(1.0, laser="1.2 0 0"), flaser(2.0, laser="2.9 0 0")))
    np.testing.assert_allclose(told.mounts["FLASER"], planar_transform(0.3, 0.0, 0.0))
    np.testing.assert_allclose(told.scans()[1].world_T_body, planar_transform(2.6, 0.0, 0.0), atol=1e-9)
    rear = "RLASER 3 1 2 3 0 0 0 0 0 0 1 h 1\n"
    backward = default_rig_for(read_carmen(write(tmp_path, rear))).sensors["RLASER"].body_T_sensor
    np.testing.assert_allclose(backward, planar_transform(0.0, 0.0, np.pi), atol=1e-9)


def test_a_rig_names_sensors_limits_ranges_and_leaves_others_out(tmp_path):
    sensor = Sensor(kind="line", record="ROBOTLASER2", range_sigma_m=0.01, range_max_m=1.5,
                    first_angle_deg=-10.0, angle_step_deg=10.0)  # fmt: skip
    log = read_carmen(write(tmp_path, robotlaser(1.0), robotlaser(2.0, k=2)), rig=Rig(sensors={"up": sensor}))
    assert [scan.sensor for scan in log.scans()] == ["up"]
    np.testing.assert_array_equal(log.scans()[0].ranges, [1.0, np.nan])
    np.testing.assert_allclose(log.scans()[0].angles, np.deg2rad([-10.0, 0.0]))
    assert log.notes == ["skipped 1 ROBOTLASER1 records, which the rig does not have"]
    with pytest.raises(LogError, match="expected records of the rig's sensors, got only ROBOTLASER1"):
        read_carmen(write(tmp_path, robotlaser(1.0)), rig=Rig(sensors={"up": sensor}))


def test_records_that_come_late_by_a_moment_are_sorted_and_said_once(tmp_path):
    log = read_carmen(write(tmp_path, flaser(2.0), odom(2.1), flaser(1.5), odom(1.4), flaser(3.0), flaser(2.0)))
    assert [scan.stamp_ns / 1e9 for scan in log.scans()] == [1.5, 2.0, 2.0, 3.0]
    assert log.notes == ["sorted 3 records whose time runs back by up to 1.000 s"]


def test_records_of_a_program_that_was_held_up_are_taken_as_written(tmp_path):
    """The poses go on as written; sorted by what they are stamped they would go back and forth."""
    held_up = [flaser(3.0, x=0.2), odom(3.01, x=0.3), flaser(3.02, x=0.4)]
    lines = [flaser(1.0, x=0.0), odom(1.4, x=0.1), *held_up, flaser(2.2, x=0.5), flaser(3.2, x=0.6)]
    log = read_carmen(write(tmp_path, *lines))
    assert [reading.odom_T_body[0, 3] for reading in log.odometry] == pytest.approx([0.1 * k for k in range(7)])
    assert [scan.stamp_ns / 1e9 for scan in log.scans()] == [1.0, 1.6, 2.0, 2.2, 3.2]
    assert log.stamped_ns == {1_600_000_000: 3_000_000_000, 2_000_000_000: 3_020_000_000}
    assert log.as_stamped([one.stamp_ns for one in log.scans()]).tolist() == [1e9, 3e9, 3.02e9, 2.2e9, 3.2e9]
    assert log.notes == ["took as written 1 records whose time runs back by up to 0.820 s"]


def test_scans_of_one_log_may_have_different_numbers_of_beams(tmp_path):
    wide = " ".join(["2.0"] * 181)
    log = read_carmen(write(tmp_path, flaser(1.0, ranges=wide[4:]), flaser(2.0, ranges=wide)))
    assert [scan.ranges.size for scan in log.scans()] == [180, 181]
    np.testing.assert_allclose([np.rad2deg(scan.angles[-1]) for scan in log.scans()], [89.0, 90.0])


@pytest.mark.parametrize("none", ["8.19", "29.99", "50.0", "79.6", "81.83", "81.91"])
def test_the_reading_that_means_none_is_found_whatever_the_laser(tmp_path, none: str):
    rng = np.random.default_rng(2)
    seen = [f"{r:.2f}" for r in rng.uniform(2.0, 7.5, 40)]
    lines = [flaser(float(t), ranges=f"{r} {none} 0.0") for t, r in enumerate(seen)]
    alone = [flaser(float(t), ranges=f"{r} 1.5") for t, r in enumerate(seen)]
    for log, rest in ((lines, [np.nan, np.nan]), (alone, [1.5])):
        for scan, written in zip(read_carmen(write(tmp_path, *log)).scans(), seen, strict=True):
            np.testing.assert_array_equal(scan.ranges, [float(written), *rest])


def test_clocks(tmp_path):
    lines = [f"FLASER 1 1.0 0 0 0 0 0 0 {ipc} h {logger}\n" for ipc, logger in ((100.0, 1.0), (101.0, 2.5))]
    path = write(tmp_path, *lines)
    assert [scan.stamp_ns for scan in read_carmen(path).scans()] == [100_000_000_000, 101_000_000_000]
    stuck = read_carmen(write(tmp_path, *(line.replace("101.0", "100.0") for line in lines)))
    assert [scan.stamp_ns for scan in stuck.scans()] == [1_000_000_000, 2_500_000_000]
    assert stuck.notes == ["all ipc times are the same; took the logger's"]


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ([odom(1.0)], r"test\.clf: expected a CARMEN log with laser records, got none"),
        ([""], r"test\.clf: expected a CARMEN log with laser records, got none"),
        ([odom(1), "FLASER 4 1 2 3 0 0 0 0 0 0 1 h 1\n", odom(2)], r"test\.clf:2: expected 15 words .* got 14"),
        (["FLASER 999999999999999999999 1 0 0 0 0 0 0 1 h 1\n", odom(2)], r"clf:1: expected as many readings"),
        (["FLASER -3 1 0 0 0 0 0 0 1 h 1\n", odom(2)], r"clf:1: expected as many readings .* '-3'"),
        (["FLASER\n", odom(2)], r"clf:1: expected as many readings"),
        ([flaser(1.0, ranges="1 x 3"), odom(2)], r"clf:1: expected numbers, got 'x'"),
        ([flaser(3.0), flaser(3.5), flaser(1.5)], r"clf:3: time runs backwards by 2\.000000 s in FLASER"),
        ([flaser("soon"), odom(2)], r"clf:1: expected a time in seconds, got 'soon'"),
        ([flaser("1e300"), odom(2)], r"clf:1: expected a time in seconds"),
        ([flaser("nan"), odom(2)], r"clf:1: expected a time in seconds"),
        ([flaser(1.0, laser="nan 0 0"), odom(2)], r"clf:1: expected a finite pose"),
        ([robotlaser(1.0, step=0.0), odom(2)], r"clf:1: expected a finite start angle and a positive step"),
        (["\x89PNG\r\n\x1a garbage\n", odom(2)], r"clf:1: expected a CARMEN record"),
        (["x" * 3_000_000], r"clf:1: expected lines shorter than"),
    ],
)
def test_bad_logs_name_file_and_line(tmp_path, lines, sentence):
    with pytest.raises(LogError, match=sentence) as caught:
        read_carmen(write(tmp_path, *lines))
    assert "\n" not in str(caught.value)


def test_gzip_cut_in_the_middle(tmp_path):
    rng = np.random.default_rng(0)
    lines = [flaser(float(t), ranges=" ".join(map(str, rng.uniform(1, 5, 50).round(3)))) for t in range(400)]
    path = write(tmp_path, *lines, name="cut.clf.gz")
    whole = read_carmen(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    message = r"cut\.clf\.gz:\d+: the gzip stream breaks off here.*; --keep-partial uses what comes before"
    with pytest.raises(LogError, match=message):
        read_carmen(path)
    part = read_carmen(path, keep_partial=True)
    assert 100 < len(part.scans()) < 300
    for a, b in zip(part.scans(), whole.scans(), strict=False):
        np.testing.assert_array_equal(a.ranges, b.ranges)
    assert "kept what came before" in part.notes[0]


def test_plain_log_cut_in_a_line(tmp_path):
    path = write(tmp_path, flaser(1.0), flaser(2.0), flaser(3.0)[:14])
    with pytest.raises(LogError, match=r"test\.clf:3: expected"):
        read_carmen(path)
    assert len(read_carmen(path, keep_partial=True).scans()) == 2
    wrong_inside = write(tmp_path, flaser(1.0), flaser(2.0)[:14] + "\n", flaser(3.0))
    with pytest.raises(LogError, match=r"test\.clf:2: expected"):
        read_carmen(wrong_inside, keep_partial=True)


def test_what_is_written_reads_back_bit_for_bit(tmp_path):
    rng = np.random.default_rng(1)
    mount = Mount(xyz_m=(0.2, 0.1, 0.5), rpy_deg=(0.0, 0.0, 30.0))
    sensor = Sensor(kind="line", record="ROBOTLASER1", body_T_sensor=mount, range_sigma_m=0.01, range_max_m=30.0)
    rig, events = Rig(sensors={"a": sensor}), []
    for k in range(20):
        stamp, pose = 10**18 + k * 123_456_789, planar_transform(*rng.standard_normal(3))
        ranges = np.where(rng.uniform(size=37) < 0.1, np.nan, rng.uniform(0.1, 29.0, 37))
        events += [OdometryReading(stamp, planar_transform(*rng.standard_normal(3)))]
        events += [LaserScan(stamp, "a", ranges, np.linspace(-2.0, 2.0, 37), pose)]
    for name in ("log.clf", "log.clf.gz"):
        write_carmen(Log(events, tmp_path), rig, tmp_path / name)
        back = read_carmen(tmp_path / name, rig=rig)
        assert_same_events(events, back.events, atol=1e-15)
        np.testing.assert_allclose(back.mounts["a"], planar_transform(0.2, 0.1, np.deg2rad(30.0)), atol=1e-12)


def test_the_writer_refuses_what_carmen_cannot_say(tmp_path):
    sensor = {"range_sigma_m": 0.01, "range_max_m": 30.0}
    rig = Rig(sensors={"a": Sensor(kind="line", record="FLASER", **sensor), "c": Sensor(kind="cloud", **sensor)})
    uneven = Rig(sensors={"a": Sensor(kind="line", record="ROBOTLASER1", **sensor)})
    scan = LaserScan(1, "a", np.ones(3), np.array([0.0, 1.0, 1.5]))
    cloud = CloudScan(1, "c", np.zeros((4, 3)))
    for described, event, sentence in (
        (rig, cloud, "expected 2D scans and odometry only"),
        (rig, scan, "expected a record ROBOTLASERk for 'a', got 'FLASER'"),
        (uneven, scan, "expected equally spaced bearings"),
    ):
        with pytest.raises(ValueError, match=sentence):
            write_carmen(Log([event], tmp_path), described, tmp_path / "x.clf")
    assert not (tmp_path / "x.clf").exists()


def test_intel_is_what_its_readme_says():
    log = read_carmen(needs("intel/intel.clf.gz"))
    scans = log.scans("FLASER")
    assert len(scans) == len(log.odometry) == 910 and not log.notes
    assert {scan.ranges.size for scan in scans} == {180}
    np.testing.assert_allclose(np.rad2deg(scans[0].angles[[0, -1]]), [-90.0, 89.0], atol=1e-9)
    assert scans[0].stamp_ns == 976_052_890_244_111_000
    ranges = np.array([scan.ranges for scan in scans])
    assert np.isnan(ranges).sum() == 4172 and np.nanmax(ranges) == 25.38
    way = np.diff([reading.odom_T_body[:2, 3] for reading in log.odometry], axis=0)
    assert np.linalg.norm(way, axis=1).sum() == pytest.approx(501.1, abs=0.1)
    sensor = default_rig_for(log).sensors["FLASER"]
    assert sensor.quantisation_m == 0.01
    np.testing.assert_allclose(sensor.body_T_sensor, np.eye(4), atol=1e-12)


def test_ranges_of_a_long_log_wait_on_the_disk(tmp_path, monkeypatch):
    path = write(tmp_path, *(flaser(float(k), ranges=f"1.{k} 2.0 3.5") for k in range(20)))
    in_memory = read_carmen(path).scans()
    monkeypatch.setattr(lazy, "_IN_MEMORY_BYTES", 100)
    log = read_carmen(path)
    for before, scan in zip(in_memory, log.scans(), strict=True):
        own = [value for name, value in vars(scan).items() if name != "angles"]
        assert isinstance(scan, LaserScan) and not any(isinstance(one, np.ndarray) for one in own)
        np.testing.assert_array_equal(scan.ranges, before.ranges)
        assert scan.angles is log.scans()[0].angles
    assert encode(log.scans()[3]) == encode(log.scans()[3].loaded())


def test_no_room_for_the_scans_of_a_long_log_is_one_sentence(tmp_path, monkeypatch):
    path = write(tmp_path, flaser(1.0), flaser(2.0))

    class Full(io.BytesIO):
        def write(self, data):
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(lazy, "SpooledTemporaryFile", lambda **_: Full())
    with pytest.raises(LogError, match=r"expected room for its scans in the folder for temporary files: No space left"):
        read_carmen(path)
