"""Depth images: one alone, and folders of them as TUM RGB-D and ICL-NUIM have them."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from slam.errors import LogError
from slam.io.clouds import read_cloud
from slam.io.clouds.depth import CAMERA_MOUNT, Camera, read_intrinsics
from slam.io.load import load
from slam.io.trajectories import Trajectory, write_tum
from slam.sensors.log import CloudScan
from tests.fuzz.wrapping import png
from tests.slam.commands import refused
from tests.slam.io.test_cloud_folders import pose

CAMERA = Camera(100.0, 90.0, 39.5, 29.5)


def write_image(path: Path, depth_m: np.ndarray, units_per_m: float = 5000.0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.round(depth_m * units_per_m).astype(np.uint16)).save(path)


def slope() -> np.ndarray:
    """Depths of the plane z = 2 + 0.5 x seen by the camera, shape (60, 80), with nothing in a corner."""
    u = (np.arange(80) - CAMERA.cx) / CAMERA.fx
    depth = np.tile(2.0 / (1.0 - 0.5 * u), (60, 1))
    depth[:3, :4] = 0.0
    return depth


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for k in range(3):
        write_image(tmp_path / "depth" / f"{k + 9}.png", slope())
    (tmp_path / "intrinsics.txt").write_text("100 90 39.5 29.5\n")
    return tmp_path


def test_points_of_a_depth_image(folder: Path):
    points = read_cloud(folder / "depth" / "9.png").points
    assert points.shape == (60, 80, 3)
    assert np.isnan(points[:3, :4]).all() and np.isfinite(points[3:]).all()
    np.testing.assert_allclose(points[3:, :, 2], 2.0 + 0.5 * points[3:, :, 0], atol=3e-4)
    assert points[40, 10, 0] < 0.0 < points[40, 10, 1]  # x to the right, y down


@pytest.mark.parametrize(
    ("text", "camera"),
    [
        ("100 90 39.5 29.5", CAMERA),
        ("100, 90, 39.5, 29.5, 1000", Camera(100.0, 90.0, 39.5, 29.5, 1000.0)),
        ("100 0 39.5\n0 -90 29.5\n0 0 1\n", Camera(100.0, -90.0, 39.5, 29.5)),
        ("100 0 39.5\n0 90 29.5\n0 0 1\n256\n", Camera(100.0, 90.0, 39.5, 29.5, 256.0)),
    ],
)
def test_intrinsics(text: str, camera: Camera, tmp_path: Path):
    (tmp_path / "intrinsics.txt").write_text(text)
    assert read_intrinsics(tmp_path / "intrinsics.txt") == camera


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "got 0 numbers"),
        ("1 2 3", "expected fx fy cx cy or a 3x3 matrix, perhaps with a scale, got 3 numbers"),
        ("0 90 1 1", "expected focal lengths and a scale that are not 0"),
        ("9 9 1 1 0", "expected focal lengths and a scale that are not 0"),
        ("nan 9 1 1", "expected focal lengths"),
        ("1 2 3 4 5 6 7 8 9", "expected a camera matrix"),
        ("a b c d", "expected numbers, got 'a b c d'"),
    ],
)
def test_wrong_intrinsics(text: str, sentence: str, tmp_path: Path):
    (tmp_path / "intrinsics.txt").write_text(text)
    with pytest.raises(LogError, match=sentence):
        read_intrinsics(tmp_path / "intrinsics.txt")


def test_a_folder_is_a_log_in_the_order_of_numbers(folder: Path):
    log, rig = load(folder)
    assert [scan.stamp_ns for scan in log.scans()] == [0, 33_333_333, 66_666_666]
    assert all(isinstance(scan, CloudScan) and scan.points.shape == (60, 80, 3) for scan in log.scans())
    np.testing.assert_array_equal(rig.sensors["camera"].body_T_sensor, CAMERA_MOUNT)
    np.testing.assert_array_equal(CAMERA_MOUNT[:3, :3] @ [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    assert log.odometry == []


@pytest.mark.parametrize("associated", [False, True])
def test_times_and_poses_as_tum_rgbd_has_them(associated: bool, folder: Path):
    stamps = np.array([1305031102_160407000, 1305031102_194330000, 1305031102_226738000])
    rows = [f"{s / 1e9:.6f} depth/{9 + k}.png" for k, s in enumerate(stamps)]
    if associated:
        rows = [f"1.5 rgb/{k}.png {row}" for k, row in enumerate(rows)]
    name = "associations.txt" if associated else "depth.txt"
    (folder / name).write_text("# timestamp filename\n" + "\n".join(rows) + "\n")
    world_T_camera = np.array([pose(0.1 * k, 0.0, 0.0) @ CAMERA_MOUNT for k in range(3)])
    write_tum(folder / "groundtruth.txt", Trajectory(stamps, world_T_camera))
    log, _ = load(folder)
    assert [scan.stamp_ns for scan in log.scans()] == stamps.tolist()
    bodies = [pose(0.1 * k, 0.0, 0.0) for k in range(3)]
    np.testing.assert_allclose([scan.world_T_body for scan in log.scans()], bodies, atol=1e-12)
    for text, message in (
        ("1.0 depth/none.png\n", r"none\.png: expected the depth image that the list names"),
        ("# x\nsoon depth/9.png\n", rf"{name}:2: expected a time and a file, got 'soon depth/9\.png'"),
    ):
        (folder / name).write_text(text)
        with pytest.raises(LogError, match=message):
            load(folder)


def test_poses_without_times_are_as_many_as_the_images(folder: Path):
    """The numbers in the names of images say nothing of the rows of a file of poses."""
    write_tum(folder / "groundtruth.txt", Trajectory(10**9 * np.arange(20), np.tile(np.eye(4), (20, 1, 1))))
    with pytest.raises(LogError, match=r"groundtruth\.txt: expected a pose for each of the 3 images, got 20"):
        load(folder)


def png_of(width: int, height: int) -> bytes:
    """A PNG that declares a size and holds next to nothing."""
    return png(struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0) + bytes(99))


def test_bad_images(folder: Path, capsys: pytest.CaptureFixture[str]):
    path = folder / "depth" / "9.png"
    whole = path.read_bytes()
    cases = dict.fromkeys((b"", b"not an image", whole[: len(whole) // 2], whole[:40]), "expected a whole PNG")
    cases[png_of(10**5, 10**5)] = "pixels, got 100000 x 100000|expected a whole PNG"
    cases[png_of(10, 10)] = "expected a whole PNG|got none that is finite"
    for data, sentence in cases.items():
        path.write_bytes(data)
        with pytest.raises(LogError, match=sentence):
            read_cloud(path)
    Image.new("RGB", (20, 20)).save(path)
    assert "9.png: expected one channel of 8 or 16 bits, got the mode RGB" in refused(capsys, "fit", path)
    write_image(path, np.zeros((20, 20)))
    assert "9.png: expected at least one point, got none that is finite" in refused(capsys, "fit", path)
    (folder / "intrinsics.txt").unlink()
    assert "expected intrinsics.txt (fx fy cx cy) beside the depth image" in refused(capsys, "fit", path)


@pytest.mark.parametrize(("width", "interlaced", "missing"), [(40, 0, 0), (40, 0, 1), (40, 1, 2000), (4, 1, 148)])
def test_an_image_with_fewer_pixels_than_it_has_room_for_is_refused(width, interlaced, missing, folder: Path):
    """Pillow fills a narrow interlaced one up with zeros, which would be pixels without a return."""
    rows = b"".join(b"\0" + bytes([9]) * width for _ in range(30))
    (folder / "intrinsics.txt").write_text("100 100 20 15\n")
    head = struct.pack(">IIBBBBB", width, 30, 8, 0, 0, 0, interlaced)
    (folder / "a.png").write_bytes(png(head + rows[: len(rows) - missing]))
    if not missing:
        assert read_cloud(folder / "a.png").points.shape == (30, width, 3)
    else:
        with pytest.raises(LogError, match=r"expected 30 rows of 4 pixels, got a PNG that ends|expected a whole PNG"):
            read_cloud(folder / "a.png")
