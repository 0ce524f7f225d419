"""ROS 1 and ROS 2 bags, written by rosbags: every layout of a cloud, mounts from tf, topics chosen and named."""

import bz2
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags is not installed")

from rosbags.rosbag1 import Writer as Writer1

from slam.errors import LogError
from slam.io import raw
from slam.io.load import load
from slam.io.raw import TooLarge, unpack
from slam.io.rosbags._salvaged import SalvagedBag
from slam.io.rosbags.reader import Topics, is_rosbag, read_rosbag
from slam.sensors.log import CloudScan, LaserScan
from slam.sensors.rig import Rig, Sensor
from spplanes.spmodel import transform_from_rpy
from tests.slam.commands import refused, run
from tests.slam.io.bags import SECOND, Messages, write
from tests.slam.io.test_cloud_folders import ROOM, pose, seen_from, walls_of

#: Where the lidar sits on the body.
MOUNT = transform_from_rpy((0.2, -0.1, 0.4, 0.5, 0.0, 0.0))
PATH = np.array([pose(0.4 * k, 0.1 * k, 0.1 * k) for k in range(4)])


def mission(messages: Messages, organised: bool = False, columns: int = 360):
    """A room from four places by a lidar on a robot, with a laser that is not wanted."""
    yield "/tf_static", SECOND, messages.tf("base_link", "mast", pose(0.2, -0.1, 0.0))
    yield "/tf_static", SECOND, messages.tf("mast", "lidar", transform_from_rpy((0.0, 0.0, 0.4, 0.5, 0.0, 0.0)))
    for k, odom_T_body in enumerate(PATH):
        stamp = (10 + k) * SECOND + 5
        points = seen_from(odom_T_body @ MOUNT, k, columns)
        yield "/odom", stamp, messages.odometry(stamp, odom_T_body)
        yield "/front/scan", stamp + 1, messages.scan(stamp, np.full(181, 2.0))
        cloud = messages.cloud(stamp, points if organised else points.reshape(-1, 3))
        yield "/lidar/points", stamp + 2, cloud


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap", "db3 alone", "mcap alone"])
def test_a_mission_in_every_kind_of_bag(kind: str, tmp_path: Path):
    path = write(tmp_path, kind, mission)
    assert is_rosbag(path)
    log, rig = load(path)
    assert log.notes[0] == "read /lidar/points (4 PointCloud2), /odom (4 Odometry); also there: /front/scan"
    scans = log.scans()
    assert [scan.stamp_ns for scan in scans] == [(10 + k) * SECOND + 5 for k in range(4)]
    assert [reading.stamp_ns for reading in log.odometry] == [scan.stamp_ns for scan in scans]
    np.testing.assert_allclose([reading.odom_T_body for reading in log.odometry], PATH, atol=1e-9)
    np.testing.assert_allclose(rig.sensors["lidar/points"].body_T_sensor, MOUNT, atol=1e-9)
    assert isinstance(scans[3], CloudScan)
    wanted = seen_from(PATH[3] @ MOUNT, 3)
    points = scans[3].points
    assert points.shape == wanted.shape
    shift = int(np.flatnonzero(np.isclose(points[0, :, 0], wanted[0, 0, 0], atol=1e-6))[0])
    np.testing.assert_allclose(np.roll(points, -shift, axis=1), wanted, atol=1e-6)


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
def test_slam_on_a_bag(kind: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write(tmp_path, kind, lambda messages: mission(messages, organised=True))
    code, _, err = run(capsys, "slam", path, "--out", tmp_path / "out")
    assert code == 0, err
    assert "read /lidar/points (4 PointCloud2)" in err
    walls = walls_of(tmp_path / "out")
    assert len([d for n, d in walls if abs(n[0]) > 0.999 and abs(d + ROOM[0]) < 0.02]) == 2
    assert run(capsys, "view", tmp_path / "out")[0] == 0
    again, _ = load(path, Rig.from_yaml(tmp_path / "out" / "rig.yaml"))
    assert [scan.sensor for scan in again.scans()] == ["lidar/points"] * 4


@pytest.mark.parametrize("layout", ["plain", "shuffled", "padded", "big", "double"])
@pytest.mark.parametrize("kind", ["ros1", "sqlite3"])
def test_clouds_of_every_layout(layout: str, kind: str, tmp_path: Path):
    points = (np.arange(4 * 50 * 3).reshape(4, 50, 3) * 0.25 + 1.0) * np.array([1.0, -0.01, 0.02])
    points[2, 7] = np.nan
    expected = points.copy()
    points[1, 3] = 0.0
    expected[1, 3] = np.nan
    path = write(tmp_path, kind, lambda m: [("/c", SECOND, m.cloud(SECOND, points, layout=layout))])
    (scan,) = read_rosbag(path).scans()
    assert isinstance(scan, CloudScan)
    np.testing.assert_allclose(scan.points, expected, atol=1e-5)


def test_laser_scans_turn_left_and_no_returns_are_nan(tmp_path: Path):
    ranges = np.linspace(1.0, 10.0, 31)
    ranges[[3, 4, 5, 6]] = np.nan, np.inf, 0.05, 20.0

    def make(messages: Messages):
        yield "/a", SECOND, messages.scan(SECOND, ranges)
        backward = {"angle_min": 1.5, "angle_max": -1.5, "angle_increment": -0.1}
        yield "/b", SECOND, messages.scan(SECOND, ranges[::-1], **backward)

    log, rig = load(write(tmp_path, "ros1", make))
    assert set(rig.of_kind("line")) == {"a", "b"}
    for scan in log.scans():
        assert isinstance(scan, LaserScan)
        assert np.flatnonzero(np.isnan(scan.ranges)).tolist() == [3, 4, 5, 6]
        np.testing.assert_allclose(scan.angles, np.linspace(-1.5, 1.5, 31), atol=1e-6)
        np.testing.assert_allclose(scan.ranges[7:], ranges[7:], atol=1e-6)


def test_an_upright_laser_is_a_push_broom_one(tmp_path: Path):
    upright = transform_from_rpy((0.0, 0.0, 0.0, 0.0, -np.pi / 2.0, 0.0))

    def make(messages: Messages):
        yield "/tf_static", SECOND, messages.tf("/base_link", "/up", upright)
        yield "/odom", SECOND, messages.odometry(SECOND, np.eye(4))
        yield "/up", SECOND, messages.scan(SECOND, np.full(31, 2.0), "/up")

    _, rig = load(write(tmp_path, "ros1", make))
    assert list(rig.of_kind("slice")) == ["up"]
    np.testing.assert_allclose(rig.sensors["up"].body_T_sensor, upright, atol=1e-12)


def moved_by_tf(root: str, body: str, inner: str = "base_link"):
    """A cloud on a body that tf moves, by whatever names."""

    def make(messages: Messages):
        yield "/tf_static", SECOND, messages.tf(body, inner, pose(0.3, 0.0, 0.2))
        yield "/tf_static", SECOND, messages.tf(inner, "lidar", MOUNT)
        for k, odom_T_body in enumerate(PATH):
            stamp = (k + 1) * SECOND
            yield "/tf", stamp, messages.tf(root, body, odom_T_body, stamp)
            yield "/points", stamp, messages.cloud(stamp, np.ones((9, 3)))

    return make


@pytest.mark.parametrize("root", ["odom", "odom_combined", "/odom", "robot_1/odom", "odometry"])
def test_tf_is_odometry_where_there_is_none(root: str, tmp_path: Path):
    def make(messages: Messages):
        yield from moved_by_tf(root, "base_footprint")(messages)
        for k in range(4):
            stamp = (k + 1) * SECOND
            yield "/tf", stamp, messages.tf("map", root, pose(0.1 * k, 0.0, 0.0), stamp)
            yield "/tf", stamp, messages.tf("base_link", "wheel", pose(0.0, 0.0, float(k)), stamp)

    log, rig = load(write(tmp_path, "ros1", make))
    np.testing.assert_allclose([reading.odom_T_body for reading in log.odometry], PATH, atol=1e-9)
    assert f"no Odometry: took tf from {root.lstrip('/')} to base_footprint" in log.notes
    np.testing.assert_allclose(rig.sensors["points"].body_T_sensor, pose(0.3, 0.0, 0.2) @ MOUNT, atol=1e-9)


def test_frames_by_option_by_rig_and_after_a_break(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write(tmp_path, "mcap", moved_by_tf("start", "hull"))
    log, _ = load(path)
    assert not log.odometry and "tf moves from start to hull; if that is odometry: --odometry-frame start" in log.notes
    log, rig = load(path, topics=Topics(odometry_frame="start", body_frame="base_link"))
    inner = pose(0.3, 0.0, 0.2)
    np.testing.assert_allclose([reading.odom_T_body for reading in log.odometry], PATH @ inner, atol=1e-9)
    np.testing.assert_allclose(rig.sensors["points"].body_T_sensor, MOUNT, atol=1e-9)
    rig.to_yaml(tmp_path / "rig.yaml")  # as a run that goes on has it
    again, _ = load(path, Rig.from_yaml(tmp_path / "rig.yaml"))
    np.testing.assert_array_equal([r.odom_T_body for r in again.odometry], [r.odom_T_body for r in log.odometry])
    _, changed = load(path, Rig(sensors=rig.sensors), topics=Topics(odometry_frame="start"))
    assert (changed.odometry_frame, changed.body_frame) == ("start", None)
    for words, sentence in (
        ("--odometry-frame odom", "--odometry-frame: expected tf from odom to a body, found none; it has start"),
        (
            "--odometry-frame start --body-frame camera",
            "--body-frame: expected tf from hull, the frame of the odometry, to camera, found none",
        ),
        (
            "--body-frame camera",
            "--body-frame: expected a frame of tf, got camera; there are base_link, hull, lidar, start",
        ),
        ("--odometry-frame start --odometry-topic /odom", "expected one source of odometry"),
    ):
        assert sentence in refused(capsys, "slam", path, "--out", tmp_path / "out", *words.split())


def test_odometry_frame_stands_in_for_a_topic(tmp_path: Path):
    def make(messages: Messages):
        yield from moved_by_tf("start", "hull")(messages)
        for k in range(4):
            yield "/odom", (k + 1) * SECOND + 1, messages.odometry((k + 1) * SECOND, np.eye(4), "hull")

    path = write(tmp_path, "ros1", make)
    log, _ = load(path, topics=Topics(odometry_frame="start"))
    np.testing.assert_allclose([reading.odom_T_body for reading in log.odometry], PATH, atol=1e-9)
    by_topic = load(path)[1].model_copy(update={"odometry_record": "/odom"})
    other, changed = load(path, by_topic, topics=Topics(odometry_frame="start"))
    assert changed.odometry_record is None and len(other.odometry) == 4


@pytest.mark.parametrize("cut", [0, 60])
def test_bags_of_2010_are_read(cut: int, tmp_path: Path):
    """Their header is roslib/Header; and what nobody reads may be defined as badly as it likes."""
    messages, path = Messages(ros1=True), tmp_path / "old.bag"
    kind = "sensor_msgs/msg/LaserScan"
    text, digest = messages.store.generate_msgdef(kind)
    text = text.replace("std_msgs/Header header", "Header header").replace("std_msgs/Header", "roslib/Header")
    with Writer1(path) as writer:
        scans = writer.add_connection("/base_scan", kind, msgdef=text, md5sum=digest)
        other = writer.add_connection("/mocap", "lab/msg/Mocap", msgdef="Markers[] m\n???\n", md5sum="0" * 32)
        for k in range(3):
            message = messages.scan((k + 1) * SECOND, np.full(181, 2.0), "base_laser")
            writer.write(other, (k + 1) * SECOND, b"\0\0\0\0")
            writer.write(scans, (k + 1) * SECOND, messages.store.serialize_ros1(message, kind))
    path.write_bytes(path.read_bytes()[: -cut or None])
    log, _ = load(path, keep_partial=cut > 0)
    assert [scan.stamp_ns for scan in log.scans()] == [SECOND, 2 * SECOND, 3 * SECOND]
    first = log.scans()[0]
    assert isinstance(first, LaserScan) and np.nanmax(np.abs(first.ranges - 2.0)) < 1e-6


def test_a_bag_whose_index_contradicts_its_records_is_read_without_it(tmp_path: Path):
    """An index that counts more messages than it lists: rosbags asserts that it does not."""
    path = write(tmp_path, "ros1", mission)
    whole, _ = load(path)
    data = bytearray(path.read_bytes())
    data[data.rindex(b"count=", 0, data.rindex(b"op=\x04")) + 6] += 1
    path.write_bytes(data)
    log, _ = load(path)
    assert [scan.stamp_ns for scan in log.scans()] == [scan.stamp_ns for scan in whole.scans()]
    assert len(log.odometry) == len(whole.odometry)
    assert "the bag's index contradicts its records; read to the end without it: nothing is missing" in log.notes
    path.write_bytes(data[:-30])
    with pytest.raises(LogError, match="expected a whole bag"):
        load(path)
    at = data.index(b"chunk_count=") + 12  # as many more chunks are stated than there are
    chunks = data[at]
    data[at] += 1
    path.write_bytes(data)
    assert f"without it: 1 of {chunks + 1} chunks is missing" in SalvagedBag(path).note


def test_the_only_file_of_a_folder_that_breaks_off_is_salvaged(tmp_path: Path):
    path = write(tmp_path, "mcap", mission)
    (inside,) = path.glob("*.mcap")
    inside.write_bytes(inside.read_bytes()[:-4000])
    with pytest.raises(LogError, match=r"expected a whole bag.*; --keep-partial uses what comes before"):
        load(path)
    log, _ = load(path, keep_partial=True)
    assert 3 <= len(log.scans()) <= 4


def test_what_tf_does_not_tell_is_said(tmp_path: Path):
    def make(messages: Messages):
        yield "/odom", SECOND, messages.odometry(SECOND, np.eye(4))
        yield "/points", SECOND, messages.cloud(SECOND, np.ones((9, 3)))
        yield "/points", SECOND + 1, messages.cloud(SECOND, np.ones((9, 3)))

    log, rig = load(write(tmp_path, "mcap", make))
    assert "no transform from base_link to lidar: /points taken at the body" in log.notes
    assert "left out 1 messages with the time of the one before" in log.notes
    np.testing.assert_array_equal(rig.sensors["points"].body_T_sensor, np.eye(4))
    given, _ = load(log.source, rig)
    assert not any("taken at the body" in note for note in given.notes)  # the rig says where it is


def test_topics_by_option_and_by_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write(tmp_path, "ros1", mission)
    log = read_rosbag(path, Topics(scans=("front/scan",)))
    assert all(isinstance(scan, LaserScan) and scan.sensor == "front/scan" for scan in log.scans())
    laser = Sensor(kind="line", record="/front/scan", range_sigma_m=0.01, range_max_m=30.0)
    log, rig = load(path, Rig(sensors={"front": laser}, odometry_record="/odom"))
    assert {scan.sensor for scan in log.scans()} == {"front"} and rig.sensors["front"] is laser
    there = "which the bag does not have; it has /lidar/points, /front/scan, /odom"
    for option, topic, sentence in (
        ("--topic", "/rear/scan", f"expected the topic /rear/scan, {there}"),
        ("--odometry-topic", "/tf_static", "expected a topic of Odometry, got /tf_static, which is of TFMessage"),
        ("--odometry-topic", "/front/scan", "expected a topic of Odometry, got /front/scan, which is of LaserScan"),
        ("--topic", "/odom", "expected a topic of LaserScan or PointCloud2, got /odom, which is of Odometry"),
    ):
        assert sentence in refused(capsys, "slam", path, "--out", tmp_path / "out", option, topic)


WRONG = {
    "no z": ({"fields": []}, "expected the fields x, y and z, got none"),
    "huge": ({"width": 2**31, "row_step": 2**32 - 1}, "expected 1 rows of 2147483648 points"),
    "short": ({"data": np.zeros(50, np.uint8)}, "expected 1 rows of 9 points of 12 bytes, got 50 bytes"),
    "step": ({"point_step": 6}, "expected fields within the 6 bytes of a point"),
}


@pytest.mark.parametrize(("change", "sentence"), WRONG.values(), ids=WRONG)
def test_wrong_clouds_name_their_topic(change: dict, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    path = write(tmp_path, "ros1", lambda m: [("/p", SECOND, m.cloud(SECOND, np.ones((9, 3)), **change))])
    said = refused(capsys, "slam", path, "--out", tmp_path / "out")
    assert f"run 1 ü.bag: /p: {sentence}" in said.replace("   ", " ")


def test_bags_without_scans_and_with_a_wrong_quaternion_are_refused(tmp_path: Path):
    def make(messages: Messages):
        message = messages.odometry(SECOND, np.eye(4))
        message.pose.pose.orientation.w = 0.0
        yield "/odom", SECOND, message
        yield "/points", SECOND, messages.cloud(SECOND, np.ones((9, 3)))

    with pytest.raises(LogError, match="expected a topic of LaserScan or PointCloud2, found none"):
        read_rosbag(write(tmp_path, "ros1", lambda messages: islice(make(messages), 1)))
    (tmp_path / "other").mkdir()
    with pytest.raises(LogError, match=r"/odom: expected a unit quaternion, got one of norm 0"):
        read_rosbag(write(tmp_path / "other", "ros1", make))


@pytest.mark.parametrize("kind", ["ros1", "ros1 bz2", "ros1 lz4", "mcap alone"])
@pytest.mark.parametrize("share", [0.6, 0.95])
def test_what_comes_before_the_break_is_kept(kind: str, share: float, tmp_path: Path):
    path = write(tmp_path, kind, mission)
    whole, _ = load(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    log, _ = load(path, keep_partial=True)
    assert log.notes[0] == "the bag breaks off and has no index; kept the messages that are whole"
    assert 1 <= len(log.scans()) <= 4 and len(log.scans()) >= int(4 * share) - 1
    for kept, scan in zip(log.scans(), whole.scans(), strict=False):
        assert isinstance(kept, CloudScan) and kept.stamp_ns == scan.stamp_ns and kept.points.shape == (32, 360, 3)
    with pytest.raises(LogError, match=r"expected a whole bag.*; --keep-partial uses what comes before"):
        load(path)


def test_whole_chunks_of_a_compressed_mcap_are_kept(tmp_path: Path):
    path = write(tmp_path, "mcap zstd alone", lambda messages: mission(messages, columns=1024))
    data = path.read_bytes()
    path.write_bytes(data[:-2000])
    log, _ = load(path, keep_partial=True)
    assert len(log.scans()) in (3, 4)
    np.testing.assert_allclose([reading.odom_T_body for reading in log.odometry][:3], PATH[:3], atol=1e-9)


def test_other_files_with_the_name_of_a_bag(tmp_path: Path):
    for name in ("a.bag", "a.mcap", "a.db3"):
        (tmp_path / name).write_bytes(b"not a bag at all\n" * 20)
        with pytest.raises(LogError, match="expected a whole bag"):
            read_rosbag(tmp_path / name)
    (tmp_path / "metadata.yaml").write_text("{{{")
    with pytest.raises(LogError, match="expected a whole bag"):
        load(tmp_path)


@pytest.mark.parametrize(
    "kind", ["ros1 bz2", "ros1 lz4", "mcap zstd alone", "sqlite3 zstd messages", "sqlite3 zstd files"]
)
def test_what_grows_out_of_proportion_is_refused(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(raw, "HARMLESS_BYTES", 1000)
    path = write(tmp_path, kind, mission)
    assert read_rosbag(path).scans()
    monkeypatch.setattr(raw, "MOST_GROWTH", 0)
    with pytest.raises(LogError, match="expected sensor data"):
        read_rosbag(path)


@pytest.mark.parametrize("kind", ["bz2", "lz4", "zstd"])
def test_unpacking_stops_before_memory_is_taken(kind: str, monkeypatch: pytest.MonkeyPatch):
    import lz4.frame
    from rosbags.rosbag2.storage_mcap import zstd

    pack = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstd.compress}[kind]
    monkeypatch.setattr(raw, "HARMLESS_BYTES", 1 << 18)
    monkeypatch.setattr(raw, "MOST_GROWTH", 2)
    assert unpack(pack(b"abc") + pack(b"def"), kind) == b"abcdef"
    for large in (pack(bytes(1 << 20)), pack(bytes(1 << 17)) * 3):
        with pytest.raises(TooLarge, match="grow out of all proportion"):
            unpack(large, kind)
    with pytest.raises(EOFError, match="break off"):
        unpack(pack(np.random.default_rng(0).bytes(1000))[:-20], kind)
