"""Folders of clouds: order, times, poses and odometry found in names and in files beside them; slam and map on them."""

import json
from pathlib import Path

import numpy as np
import pytest

from slam.errors import LogError
from slam.geometry.frames import planar_transform as pose
from slam.io.cloud_folders import SCAN_PERIOD_NS, clouds_in, read_cloud_folder
from slam.io.default_rigs import cloud_rig
from slam.io.load import load
from slam.io.trajectories import Trajectory, write_kitti, write_tum
from slam.sensors.log import CloudScan, Log
from spplanes._check import FloatArray
from spplanes.clouds.arrange import Grid, arrange, range_image
from tests.slam.commands import refused, run
from tests.slam.real_data import needs
from tests.spplanes.scenes import spun, to_walls

#: Half sizes of the room round the world's origin, m.
ROOM = np.array([4.0, 3.0, 1.3])
#: Two scans of a CARMEN log.
CARMEN_LINES = "".join(f"FLASER 3 1.0 2.0 1.5 0 0 0 {k}.0 0 0 {k}.0 host {k}.0\n" for k in (1, 2))


def beams(columns: int = 360, rows: int = 32) -> FloatArray:
    """Directions of a spinning lidar, shape (rows, columns, 3)."""
    return spun(np.deg2rad(np.linspace(30, -30, rows)), np.deg2rad(np.arange(columns) * 360 / columns))


def seen_from(world_T_sensor: FloatArray, seed: int, columns: int = 360) -> FloatArray:
    """The room from a pose with 10 mm of noise, in the sensor's frame, shape (32, columns, 3)."""
    local = beams(columns)
    rays, eye = local @ world_T_sensor[:3, :3].T, world_T_sensor[:3, 3]
    reach = to_walls(rays, -ROOM - eye, ROOM - eye)
    return (reach + np.random.default_rng(seed).normal(0.0, 0.01, reach.shape))[..., None] * local


POSES = np.array([pose(0.4 * k, 0.2 * k, 0.1 * k) for k in range(4)])


def folder_read(folder: Path) -> Log:
    """A folder of clouds of a sensor nobody describes."""
    ((name, sensor),) = cloud_rig().sensors.items()
    return read_cloud_folder(folder, name, sensor)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four unordered clouds with a start in the middle of a ring."""
    place = tmp_path / "Räume 1"
    place.mkdir()
    for k, world_T_sensor in enumerate(POSES):
        np.save(place / f"scan {k + 8}.npy", seen_from(world_T_sensor, k).reshape(-1, 3).astype(np.float32))
    return place


def test_numbers_in_names_are_numbers(folder: Path):
    assert [path.name for path in clouds_in(folder)[0]] == ["scan 8.npy", "scan 9.npy", "scan 10.npy", "scan 11.npy"]
    log = folder_read(folder)
    assert [scan.stamp_ns for scan in log.scans()] == [k * SCAN_PERIOD_NS for k in range(4)]
    assert log.odometry == []
    assert all(isinstance(scan, CloudScan) and scan.points.shape == (32, 360, 3) for scan in log.scans())


@pytest.mark.parametrize(
    ("names", "stamps"),
    [
        (("1305031102.5", "1305031103.25"), (1305031102500000000, 1305031103250000000)),
        (("1305031102", "1305031104"), (1305031102000000000, 1305031104000000000)),
        (("1305031102500", "1305031102600"), (1305031102500000000, 1305031102600000000)),
        (("1305031102500000", "1305031102500001"), (1305031102500000000, 1305031102500001000)),
        (("1305031102500000000", "1305031102500000007"), (1305031102500000000, 1305031102500000007)),
        (("0000000000", "0000000001"), (0, SCAN_PERIOD_NS)),
        (("cloud_1_of_2", "cloud_2_of_2"), (0, SCAN_PERIOD_NS)),
    ],
)
def test_times_in_names(names: tuple[str, ...], stamps: tuple[int, ...], tmp_path: Path):
    for name in names:
        np.save(tmp_path / f"{name}.npy", np.eye(3))
    assert tuple(scan.stamp_ns for scan in folder_read(tmp_path).scans()) == stamps


def test_times_beside(folder: Path):
    (folder / "times.txt").write_text("0.0\n0.103\n0.206\n3.09e-01\n")
    assert [scan.stamp_ns for scan in folder_read(folder).scans()] == [0, 103_000_000, 206_000_000, 309_000_000]
    for times, message in (
        ("0.0\n0.1\n", r"times\.txt: expected 4 times, one for each cloud, got 2"),
        ("0.0\n0.2\n0.1\n0.3\n", "expected times of the clouds that ascend"),
    ):
        (folder / "times.txt").write_text(times)
        with pytest.raises(LogError, match=message):
            folder_read(folder)


def poses_of(log) -> FloatArray:
    return np.array([scan.world_T_body for scan in log.scans()])


def test_tum_poses_at_other_times_are_interpolated(folder: Path):
    (folder / "times.txt").write_text("10.0\n10.25\n10.5\n11.0\n")
    straight = np.array([pose(t, 0.0, 0.0) for t in (0.0, 0.5, 1.0)])
    write_tum(folder / "poses.txt", Trajectory(np.array([100, 105, 110]) * 10**8, straight))
    np.testing.assert_allclose(poses_of(folder_read(folder))[:, 0, 3], [0.0, 0.25, 0.5, 1.0], atol=1e-12)
    write_tum(folder / "poses.txt", Trajectory(np.array([100, 105, 109]) * 10**8, straight))
    folder_read(folder)
    write_tum(folder / "poses.txt", Trajectory(np.array([90, 92, 101]) * 10**8, straight))
    with pytest.raises(LogError, match=r"scan 11\.npy: expected a pose within 0\.5 s of the cloud's time, found none"):
        folder_read(folder)


def test_kitti_poses_in_order_or_by_number(folder: Path):
    write_kitti(folder / "poses.txt", POSES)
    np.testing.assert_array_equal(poses_of(folder_read(folder)), POSES)
    many = np.array([pose(float(k), 0.0, 0.0) for k in range(12)])
    write_kitti(folder / "poses.txt", many)
    np.testing.assert_array_equal(poses_of(folder_read(folder))[:, 0, 3], [8.0, 9.0, 10.0, 11.0])
    write_kitti(folder / "poses.txt", many[:11])
    with pytest.raises(LogError, match="expected a pose for each of the 4 clouds, got 11"):
        folder_read(folder)


def test_kitti_layout(tmp_path: Path):
    (tmp_path / "velodyne").mkdir()
    for k in range(3):
        points = np.hstack((np.random.default_rng(k).normal(0.0, 5.0, (50, 3)), np.zeros((50, 1))))
        points.astype("<f4").tofile(tmp_path / "velodyne" / f"{k:06d}.bin")
    (tmp_path / "times.txt").write_text("0.0\n0.1\n0.2\n")
    write_kitti(tmp_path / "poses.txt", POSES[:3])
    log, rig = load(tmp_path)
    assert [scan.stamp_ns for scan in log.scans()] == [0, 10**8, 2 * 10**8] and rig.of_kind("cloud")
    np.testing.assert_array_equal(poses_of(log), POSES[:3])


def test_the_most_clouds_of_one_format_are_the_scans(folder: Path):
    for name, suffix in (("notes.txt", ".npy"), ("whole.ply", ".ply")):  # arrays may be anything, PLY files are clouds
        (folder / name).write_text("seen on Monday\n")
        assert {path.suffix for path in clouds_in(folder)[0]} == {suffix}


def test_what_a_mixed_folder_leaves_out_is_said(tmp_path: Path):
    whole = np.random.default_rng(0).uniform(1.0, 2.0, (40, 3))
    for name in ("0.xyz", "1.xyz", "2.xyz"):
        np.savetxt(tmp_path / name, whole)
    assert not [note for note in load(tmp_path)[0].notes if "left out" in note]
    (tmp_path / "photo.png").write_bytes(b"")  # pictures are no clouds where there are others
    (tmp_path / "whole.ply").write_text("ply\n")
    assert "read 3 .xyz clouds, left out 1 .ply" in load(tmp_path)[0].notes
    (tmp_path / "log.clf").write_text(CARMEN_LINES)
    log, _ = load(tmp_path)
    assert len(log.scans()) == 2
    assert "read a mission's log, left out clouds in the same folder" in log.notes


def test_a_folder_of_bags_is_no_log_and_a_map_needs_poses(folder: Path, tmp_path: Path, capsys):
    (tmp_path / "bags").mkdir()
    for name in ("monday.bag", "tuesday.bag"):
        (tmp_path / "bags" / name).write_bytes(b"#ROSBAG V2.0\n")
    sentence = refused(capsys, "slam", tmp_path / "bags", "--out", tmp_path / "run")
    assert "expected one log, got a folder of 2 bags: give one of them, such as monday.bag" in sentence
    assert "expected a pose with every scan" in refused(capsys, "map", folder, "--out", tmp_path / "map")


def walls_of(path: Path) -> list[tuple[FloatArray, float]]:
    document = json.loads((path / "planes.json").read_text())
    return [(np.array(plane["normal"]), plane["d"]) for plane in document["planes"] if plane["n_points"] > 2000]


@pytest.mark.parametrize("command", ["map", "slam"])
def test_the_room_comes_out(command: str, folder: Path, capsys: pytest.CaptureFixture[str]):
    write_kitti(folder / "poses.txt", POSES)
    code, _, err = run(capsys, command, folder, "--out", folder.parent / "run")
    assert code == 0, err
    walls = walls_of(folder.parent / "run")
    for normal in (*np.eye(3), *-np.eye(3)):
        assert [d for n, d in walls if n @ normal > 0.9999] == [pytest.approx(-ROOM @ np.abs(normal), abs=0.01)]


@pytest.mark.parametrize("order", ["by row", "by column", "shuffled"])
@pytest.mark.parametrize("columns", [360, 1024])
def test_rings_are_found_in_any_order(order: str, columns: int):
    grid = seen_from(pose(0.3, -0.2, 0.4), 1, columns)
    points = grid.reshape(-1, 3) if order == "by row" else grid.transpose(1, 0, 2).reshape(-1, 3)
    if order == "shuffled":
        points = np.random.default_rng(0).permutation(points)
    image = range_image(points)
    assert image.shape == grid.shape
    assert np.isfinite(image).all()
    first = np.flatnonzero((image[0] == grid[0, 0]).all(axis=-1))
    np.testing.assert_array_equal(np.roll(image, -first[0], axis=1), grid)


@pytest.mark.parametrize("share", [0.5, 0.3, 0.15])
def test_cells_of_a_thinned_cloud_are_about_as_wide_as_high(share: float):
    """Rows of several rings each, cut as finely as the beams were, would leave neighbours that lie on a zigzag."""
    points = seen_from(pose(0.3, -0.2, 0.4), 1, 1024).reshape(-1, 3)
    rng = np.random.default_rng(0)
    rows, columns, _ = range_image(points[rng.random(len(points)) < share]).shape
    assert 0.25 < (60.0 / rows) / (360.0 / columns) < 4.0


def test_a_rig_states_the_range_image(folder: Path):
    _, rig = load(folder)
    scanner = rig.sensors["scanner"].model_copy(update={"rows": 16, "columns": 180})
    rig.model_copy(update={"sensors": {"top": scanner}}).to_yaml(folder / "rig.yaml")
    log, read = load(folder)
    assert read.sensors["top"].rows == 16
    assert [scan.points.shape for scan in log.scans("top") if isinstance(scan, CloudScan)] == [(16, 180, 3)] * 4
    text = (folder / "rig.yaml").read_text().replace("columns: 180", "range_min_m: 0.1")
    (folder / "rig.yaml").write_text(text)
    with pytest.raises(LogError, match=r"rig\.yaml: sensors\.top"):
        load(folder)


def test_poses_of_the_files_themselves_are_the_sensors(tmp_path: Path):
    from tests.slam.io.test_clouds import pcd

    for k in range(2):
        (tmp_path / f"{k}.pcd").write_bytes(pcd().replace(b"VIEWPOINT 0 0 0", f"VIEWPOINT {k} 0 1".encode()))
    mounted = "{kind: cloud, body_T_sensor: {xyz_m: [0, 0, 1]}, range_sigma_m: 0.01, range_max_m: 50}"
    (tmp_path / "rig.yaml").write_text(f"sensors:\n  top: {mounted}\n")
    log, _ = load(tmp_path)
    np.testing.assert_allclose(poses_of(log), [pose(0.0, 0.0, 0.0), pose(1.0, 0.0, 0.0)], atol=1e-12)


def test_the_nearer_of_two_points_hides_the_other():
    image = range_image(np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 0.5], [0.0, -1.0, -0.5]]), Grid(3, 4))
    kept = image[np.isfinite(image[..., 0])].tolist()
    assert [1.0, 0.0, 0.0] in kept and [2.0, 0.0, 0.0] not in kept and len(kept) == 3


def test_lines_of_a_turning_laser_keep_their_order_and_lose_their_doubles():
    grid = 3.0 * spun(np.deg2rad(np.arange(-60, 81.0)), np.deg2rad(np.arange(0.0, 160.0, 4.0))).swapaxes(0, 1)
    lost = np.random.default_rng(0).random(grid.shape[:2]) < 0.05
    lost[0, [0, -1]] = False
    rows = [line[~gone] for line, gone in zip(grid, lost, strict=True)]
    twice = np.concatenate([np.concatenate((row, row)) for row in rows])
    arranged = arrange(twice)
    np.testing.assert_array_equal(arranged, np.where(lost[..., None], np.nan, grid))


def test_whole_turns_begin_at_a_corner():
    here = pose(0.3, -0.2, 0.4)
    grid = seen_from(here, 1)
    turned = arrange(grid)
    first = turned[16, 0] @ here[:3, :3].T + here[:3, 3]
    np.testing.assert_allclose(np.abs(first[:2]), ROOM[:2], atol=0.15)
    offset = int(np.flatnonzero((grid[16] == turned[16, 0]).all(axis=-1))[0])
    np.testing.assert_array_equal(np.roll(turned, offset, axis=1), grid)


def test_the_room_of_pcl_in_lines():
    log, rig = load(needs("pcl_room"))
    (name,) = rig.of_kind("cloud")
    assert [scan.points.shape for scan in log.scans(name) if isinstance(scan, CloudScan)] == [(318, 181, 3)] * 2
