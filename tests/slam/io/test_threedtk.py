"""3DTK folders: axes, units, organisation, and what is said about broken ones."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.errors import LogError
from slam.io.load import load
from slam.io.threedtk import read_3dtk, read_frames, read_points, read_pose, to_right_handed
from slam.sensors.log import CloudScan
from tests.slam.real_data import needs

LINES, BEAMS = 12, 40


def scanner_points(range_cm: float = 250.0) -> np.ndarray:
    """A scanner that tilts about 3DTK's x axis, every beam at one range, shape (LINES * BEAMS, 3), cm."""
    bearing = np.deg2rad(np.linspace(0.0, 180.0, BEAMS))
    tilt = np.deg2rad(np.linspace(-40.0, 60.0, LINES))[:, None]
    x, across = np.cos(bearing) + 0.0 * tilt, np.sin(bearing)
    return range_cm * np.stack((x, across * np.sin(tilt), across * np.cos(tilt)), axis=-1).reshape(-1, 3)


CUT_OFF = gzip.compress(scanner_points().tobytes())[:200]


def write_scan(folder: Path, number: int, points: np.ndarray, pose: str = "0 0 0\n0 0 0\n", *, packed: bool = True):
    folder.mkdir(parents=True, exist_ok=True)
    text = "".join(f"{x:.6g} {y:.6g} {z:.6g}\n" for x, y, z in points).encode()
    name = f"scan{number:03d}.3d" + (".gz" if packed else "")
    (folder / name).write_bytes(gzip.compress(text) if packed else text)
    (folder / f"scan{number:03d}.pose").write_text(pose, encoding="ascii")


def test_axes_units_and_organisation(tmp_path: Path):
    points = scanner_points()
    points[5] = [0.0, 0.0, 3276.0]
    write_scan(tmp_path, 0, points, packed=False)
    scan = read_3dtk(tmp_path).scans()[0]
    assert isinstance(scan, CloudScan)
    assert scan.points.shape == (LINES, BEAMS, 3)
    # 3DTK x right, y up, z forward, cm -> x forward, y left, z up, m
    right, up, forward = points[100] / 100.0
    np.testing.assert_allclose(scan.points.reshape(-1, 3)[100], [forward, -right, up], atol=1e-5)
    assert np.isnan(scan.points[0, 5]).all()
    assert np.isfinite(scan.points).all(axis=2).sum() == LINES * BEAMS - 1


def test_scans_in_the_order_of_their_numbers_with_their_poses(tmp_path: Path):
    for number, x in ((10, 300.0), (2, 100.0)):
        write_scan(tmp_path, number, scanner_points(), pose=f"{x} 0 0\n0 90 0\n")
    log = read_3dtk(tmp_path)
    assert [reading.odom_T_body[1, 3] for reading in log.odometry] == [-1.0, -3.0]
    # 3DTK's y points up and is left-handed: +90 deg about it turns right, from forward to the right
    forward = log.odometry[0].odom_T_body[:3, :3] @ [1.0, 0.0, 0.0]
    np.testing.assert_allclose(forward, [0.0, -1.0, 0.0], atol=1e-12)


def test_a_point_moved_before_or_after_the_change_of_axes_is_the_same(tmp_path: Path):
    rng = np.random.default_rng(0)
    (tmp_path / "a.pose").write_text("12 -30 45\n10 -20 30\n", encoding="ascii")
    turn = Rotation.from_euler("XYZ", [10.0, -20.0, 30.0], degrees=True)
    left_handed = turn.as_matrix() @ (q := rng.normal(size=3)) + [12.0, -30.0, 45.0]
    swap = np.array([[0, 0, 1], [-1, 0, 0], [0, 1, 0]]) / 100.0
    pose = read_pose(tmp_path / "a.pose")
    np.testing.assert_allclose(pose[:3, :3] @ (swap @ q) + pose[:3, 3], swap @ left_handed, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("scan000.pose", b"0 0 a\n0 0 0\n", r"scan000\.pose:1: expected numbers, got '0 0 a'"),
        ("scan000.pose", b"0 0 0\n0 0\n", r"scan000\.pose: expected six numbers \(x y z rx ry rz\), got 5"),
        ("scan000.pose", b"0 0 nan\n0 0 0\n", r"scan000\.pose:1: expected finite numbers"),
        ("scan000.pose", None, r"scan000\.pose: expected the pose of the scan beside it, found no such file"),
        ("scan000.3d", b"1 2 3\n4 5 x\n", r"scan000\.3d:2: expected numbers, got '4 5 x'"),
        ("scan000.3d", b"1 2 3\n4 5\n", r"scan000\.3d:2: expected 3 numbers, got 2 words"),
        ("scan000.3d", b"", r"scan000\.3d: expected lines of three numbers, got an empty file"),
        ("scan000.3d", bytes(range(256)), r"scan000\.3d:2: expected numbers as text, got other bytes"),
        ("scan000.3d", b"0 0 3276\n1 1 3276\n", r"scan000\.3d: expected at least one return within 32 m, got none"),
        ("scan000.3d", b"1 2 inf\n", r"scan000\.3d:1: expected finite numbers"),
        ("scan000.3d.gz", CUT_OFF, r"scan000\.3d\.gz: the gzip data is cut off or damaged"),
    ],
)
def test_a_scan_or_a_pose_that_is_bad_is_named_with_its_line(tmp_path: Path, name: str, content: bytes, message: str):
    write_scan(tmp_path, 0, scanner_points(), packed=name.endswith("gz"))
    (tmp_path / name).unlink()
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(LogError, match=message):
        read_3dtk(tmp_path)


def test_neither_nothing_nor_an_empty_folder_is_a_log(tmp_path: Path):
    with pytest.raises(LogError, match="expected a log file or a folder of scans, found nothing"):
        load(tmp_path / "nowhere")
    with pytest.raises(LogError, match="expected a folder with"):
        load(tmp_path)


def test_the_real_corridor_is_organised_and_its_registration_reads():
    folder = needs("3dtk_corridor")
    points = read_points(folder / "scan000.3d.gz")
    assert points.shape == (226, 360, 3)
    assert 0.01 < np.isnan(points[..., 0]).mean() < 0.03
    final = read_frames(folder / "scan002.frames.4cc29d4c")
    np.testing.assert_allclose(final[:3, 3], [3.37786, 0.0805008, -0.156539], atol=1e-6)
    # the first line of a .frames file is the initial pose: the .pose file in 3DTK's own matrix form
    first = (folder / "scan002.frames.4cc29d4c").read_text().splitlines()[0]
    matrix = np.array([float(word) for word in first.split()[:16]]).reshape(4, 4, order="F")
    np.testing.assert_allclose(read_pose(folder / "scan002.pose"), to_right_handed(matrix), atol=1e-5)
