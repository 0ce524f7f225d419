"""LAS, LAZ and E57 as laspy and pye57 write them."""

import builtins
from pathlib import Path

import numpy as np
import pytest

from slam.errors import LogError, MissingPackageError
from slam.io.clouds import read_cloud
from slam.io.clouds.survey import read_e57_scans
from slam.io.load import load
from slam.sensors.log import CloudScan
from tests.slam.commands import refused
from tests.slam.io.test_cloud_folders import POSES, seen_from

POINTS = np.random.default_rng(0).normal((1000.0, 2000.0, 50.0), 5.0, (300, 3))


def write_las(path: Path, points: np.ndarray = POINTS) -> Path:
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=3, version="1.2")
    header.offsets, header.scales = np.floor(points.min(axis=0)), np.full(3, 0.001)
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(str(path))
    return path


def write_e57(path: Path, scans: list[tuple[np.ndarray, np.ndarray | None]], *, organised: bool = False) -> Path:
    pye57 = pytest.importorskip("pye57")
    from scipy.spatial.transform import Rotation

    with pye57.E57(str(path), mode="w") as file:
        for grid, pose in scans:
            points = grid.reshape(-1, 3)
            finite = np.isfinite(points).all(axis=1)
            data = {f"cartesian{axis}": points[finite, k] for k, axis in enumerate("XYZ")}
            if organised:
                rows, columns = np.indices(grid.shape[:2])
                data["rowIndex"] = rows.ravel()[finite].astype(np.int32)
                data["columnIndex"] = columns.ravel()[finite].astype(np.int32)
            turn = None if pose is None else Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
            file.write_scan_raw(data, rotation=turn, translation=None if pose is None else pose[:3, 3])
    return path


@pytest.mark.parametrize("name", ["a b.las", "ä.laz"])
def test_las(name: str, tmp_path: Path):
    np.testing.assert_allclose(read_cloud(write_las(tmp_path / name)).points, POINTS, atol=6e-4)


@pytest.mark.parametrize("name", ["a.las", "a.laz"])
def test_las_that_declares_billions_of_points_records_or_chunks(name: str, tmp_path: Path):
    path = write_las(tmp_path / name)
    whole = path.read_bytes()
    start = int.from_bytes(whole[96:100], "little")
    places = {
        107: r"bytes for 4000000000 points, got|expected sensor data, got \d+ bytes that grow to",
        100: "bytes for 4000000000 records before the points",
    }
    if name == "a.laz":
        table = int.from_bytes(whole[start : start + 8], "little")
        places[table + 4] = "bytes for 4000000000 chunks of points"
    for place, message in places.items():
        path.write_bytes(whole[:place] + (4_000_000_000).to_bytes(4, "little") + whole[place + 4 :])
        with pytest.raises(LogError, match=message):
            read_cloud(path)


def test_e57_with_a_pose_and_organised_without_one(tmp_path: Path):
    cloud = read_cloud(write_e57(tmp_path / "ä b.e57", [(POINTS, POSES[2])]))
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-9)
    np.testing.assert_allclose(cloud.world_T_sensor, POSES[2], atol=1e-9)
    grid = seen_from(POSES[1], 0)
    grid[3, 5:9] = np.nan
    cloud = read_cloud(write_e57(tmp_path / "a.e57", [(grid, None)], organised=True))
    np.testing.assert_allclose(cloud.points, grid, atol=1e-9)
    assert cloud.world_T_sensor is None


def test_e57_of_several_scans_is_a_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    scans = [(seen_from(pose, k), pose) for k, pose in enumerate(POSES)]
    path = write_e57(tmp_path / "house.e57", scans, organised=True)
    read = read_e57_scans(path)
    assert len(read) == 4
    np.testing.assert_allclose(read[2].points, scans[2][0], atol=1e-9)
    assert "expected one scan, got 4" in refused(capsys, "fit", path)
    log, _ = load(path)
    np.testing.assert_allclose([scan.world_T_body for scan in log.scans()], POSES, atol=1e-9)
    assert all(isinstance(scan, CloudScan) and scan.points.shape == (32, 360, 3) for scan in log.scans())


@pytest.mark.parametrize(
    ("package", "name", "sentence"),
    [
        ("laspy", "a.las", "reading this needs laspy: pip install 'spplanes[las]'"),
        ("pye57", "a.e57", "reading this needs pye57: pip install 'spplanes[e57]'"),
        ("rosbags", "a.bag", "reading this needs rosbags: pip install 'spplanes[ros]'"),
    ],
)
def test_what_to_install(package: str, name: str, sentence: str, tmp_path: Path, monkeypatch, capsys):
    (tmp_path / name).write_bytes(b"ASTM-E57" + bytes(100))
    real = builtins.__import__

    def without(module: str, *rest):
        if module.split(".")[0] == package:
            raise ImportError(module)
        return real(module, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    is_log = name == "a.bag"
    words = ("slam", tmp_path / name, "--out", tmp_path / "o") if is_log else ("fit", tmp_path / name)
    assert sentence in refused(capsys, *words)
    with pytest.raises(MissingPackageError):
        load(tmp_path / name) if is_log else read_cloud(tmp_path / name)
