"""Truth is never odometry: what a folder calls poses is not taken for it, a file given is, and says so."""

from pathlib import Path

import numpy as np
import pytest

from slam.errors import LogError
from slam.geometry.frames import planar_transform as pose
from slam.io.cloud_folders import write_cloud_folder
from slam.io.clouds.depth import CAMERA_MOUNT
from slam.io.load import load
from slam.io.scan_files import with_odometry
from slam.io.trajectories import Trajectory, write_kitti, write_tum
from slam.sensors.log import LaserScan, Log, OdometryReading
from slam.simulation import simulate_mission
from tests.slam.io.test_cloud_folders import POSES, seen_from
from tests.slam.io.test_depth import slope, write_image

SECOND = 10**9


@pytest.fixture
def clouds(tmp_path: Path) -> Path:
    """Four clouds without times."""
    (place := tmp_path / "clouds").mkdir()
    for k, world_T_sensor in enumerate(POSES):
        np.save(place / f"{k}.npy", seen_from(world_T_sensor, k, 90).reshape(-1, 3))
    return place


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """Three depth images a second apart, with the camera's ground truth beside them."""
    place = tmp_path / "images"
    for k in range(3):
        write_image(place / "depth" / f"{k}.png", slope())
    (place / "intrinsics.txt").write_text("100 90 39.5 29.5\n")
    (place / "depth.txt").write_text("".join(f"{5 + k}.0 depth/{k}.png\n" for k in range(3)))
    truth = np.array([pose(0.1 * k, 0.0, 0.2 * k) @ CAMERA_MOUNT for k in range(3)])
    write_tum(place / "groundtruth.txt", Trajectory((5 + np.arange(3)) * SECOND, truth))
    return place


def laser_log(n: int = 5) -> Log:
    """A 2D log with odometry of its own."""
    events = []
    for k in range(n):
        events.append(OdometryReading(k * SECOND, pose(0.5 * k, 0.0, 0.0)))
        events.append(LaserScan(k * SECOND, "laser", np.ones(4), np.arange(4.0), pose(9.0, 9.0, 0.0)))
    return Log(events, Path("drive.clf"))


@pytest.mark.parametrize("name", ["poses.tum", "poses.txt", "trajectory.tum"])
def test_poses_beside_clouds_are_poses_and_no_odometry(clouds: Path, name: str):
    """Of clouds without times they are the times too."""
    stamps = np.array([5, 6, 8, 9]) * SECOND
    write_tum(clouds / name, Trajectory(stamps, POSES))
    log, _ = load(clouds)
    assert [scan.stamp_ns for scan in log.scans()] == stamps.tolist()
    assert log.odometry == [] and log.odometry_source is None
    np.testing.assert_allclose([scan.world_T_body for scan in log.scans()], POSES, atol=1e-12)
    assert log.notes == [f"no odometry: the poses of {name} are not taken for it (for slam: --odometry {name})"]
    given, _ = load(clouds, odometry=clouds / name)
    np.testing.assert_allclose([one.odom_T_body for one in given.odometry], POSES, atol=1e-12)
    assert given.notes == [f"odometry: 4 poses of {name}"] and given.odometry_source == clouds / name


def test_odometry_given_takes_the_place_of_the_folders_own(clouds: Path, tmp_path: Path):
    write_kitti(clouds / "odometry.txt", POSES)
    write_kitti(clouds / "poses.txt", POSES[::-1])
    log, _ = load(clouds)
    np.testing.assert_array_equal([one.odom_T_body for one in log.odometry], POSES)
    np.testing.assert_array_equal([one.world_T_body for one in log.scans()], POSES[::-1])
    assert log.notes == []
    drifting = np.array([pose(0.3 * k, 0.0, 0.0) for k in range(4)])
    write_kitti(tmp_path / "other.txt", drifting)
    log, _ = load(clouds, odometry=tmp_path / "other.txt")
    np.testing.assert_array_equal([one.odom_T_body for one in log.odometry], drifting)
    write_kitti(tmp_path / "other.txt", drifting[:2])
    with pytest.raises(LogError, match=r"other\.txt: expected a pose for each of the 4 clouds, got 2"):
        load(clouds, odometry=tmp_path / "other.txt")


def test_the_simulators_clouds_have_both_and_only_odometry_is_it(tmp_path: Path):
    mission = simulate_mission("hall", n_scans=3, seed=0)
    write_cloud_folder(mission.log, tmp_path)
    log, _ = load(tmp_path)
    before = [one.odom_T_body for one in mission.log.odometry]
    np.testing.assert_allclose([one.odom_T_body for one in log.odometry], before, atol=1e-12)


def test_ground_truth_of_a_camera_is_no_odometry_unless_asked_for(images: Path, tmp_path: Path):
    log, rig = load(images)
    assert log.odometry == [] and rig.of_kind("cloud")
    assert log.notes == ["no odometry: the poses of groundtruth.txt are not taken for it"]
    body = np.array([pose(0.1 * k, 0.0, 0.2 * k) for k in range(3)])
    given, _ = load(images, odometry=images / "groundtruth.txt")
    np.testing.assert_allclose([one.odom_T_body for one in given.odometry], body, atol=1e-12)
    write_tum(images / "odometry.tum", Trajectory((5 + np.arange(3)) * SECOND, body))
    own, _ = load(images)
    np.testing.assert_allclose([one.odom_T_body for one in own.odometry], body, atol=1e-12)
    other = tmp_path / "elsewhere.tum"
    write_tum(other, Trajectory((4 + np.arange(5)) * SECOND, np.tile(np.eye(4), (5, 1, 1))))
    replaced, _ = load(images, odometry=other)
    assert len(replaced.odometry) == 5
    assert replaced.notes[-1] == "odometry: 5 poses of elsewhere.tum; the log's own 3 readings are left out"


def test_a_log_of_any_kind_gets_the_odometry_of_a_file(tmp_path: Path):
    log, file = laser_log(), tmp_path / "o.tum"
    given = Trajectory(np.arange(9) * SECOND // 2, np.array([pose(0.1 * k, 1.0, 0.0) for k in range(9)]))
    write_tum(file, given)
    moved = with_odometry(log, file)
    assert [one.stamp_ns for one in moved.odometry] == given.stamps_ns.tolist()
    np.testing.assert_allclose([one.odom_T_body for one in moved.odometry], given.poses, atol=1e-12)
    assert moved.scans() == log.scans()
    stamps = [event.stamp_ns for event in moved.events]
    assert stamps == sorted(stamps) and isinstance(moved.events[0], OdometryReading)
    assert moved.notes == ["odometry: 9 poses of o.tum; the log's own 5 readings are left out"]
    assert len(log.odometry) == 5 and log.notes == []


def test_odometry_that_does_not_reach_all_scans_is_refused(tmp_path: Path):
    """Beyond its ends it would stand still, and say so with the certainty of wheels."""
    file = tmp_path / "o.tum"
    for first, n in ((0, 3), (10**6, 5)):
        write_tum(file, Trajectory((first + np.arange(n)) * SECOND, np.tile(np.eye(4), (n, 1, 1))))
        with pytest.raises(LogError, match=r"o\.tum: expected odometry at the times of all 5 scans, got it from"):
            with_odometry(laser_log(), file)
    write_tum(file, Trajectory(np.array([4, 36]) * SECOND // 10, np.tile(np.eye(4), (2, 1, 1))))
    assert len(with_odometry(laser_log(), file).odometry) == 2  # half a second is no gap
    file.write_text("1 2 3\n")
    with pytest.raises(LogError, match=r"o\.tum:1: expected 8"):
        with_odometry(laser_log(), file)


def test_what_a_rig_that_nobody_gave_takes_for_granted_is_said(clouds: Path, images: Path):
    (sentence,) = load(clouds)[0].assumed
    assert sentence.startswith("no rig: scanner is taken for a 3D sensor with 20 mm of noise, at the body's origin")
    (sentence,) = load(images)[0].assumed
    assert "camera is taken for a 3D sensor with 1.5 mm of noise and " in sentence
    _, rig = load(clouds)
    assert load(clouds, rig)[0].assumed == []
    rig.to_yaml(clouds / "rig.yaml")
    assert load(clouds)[0].assumed == []
