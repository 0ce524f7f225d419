"""`spplanes fit`: planes of one cloud, with the noise measured where nobody states it."""

import json
from pathlib import Path

import numpy as np
import pytest

from slam.errors import LogError
from slam.io.clouds import Cloud, read_cloud
from slam.io.planes_json import read_planes
from slam.runs.cloud_fit import fit_cloud
from spplanes.clouds.scatter import misses_of
from spplanes.segmentation.config import ValidationConfig
from tests.slam.commands import refused, run
from tests.slam.io.test_cloud_folders import ROOM, beams, pose, seen_from
from tests.slam.ply_tables import read_tables
from tests.slam.real_data import needs

HERE = pose(0.3, -0.4, 0.2)


@pytest.fixture
def room(tmp_path: Path) -> Path:
    path = tmp_path / "Zimmer [7] Süd.npy"
    np.save(path, seen_from(HERE, 5))
    return path


@pytest.mark.parametrize("sigma", [0.001, 0.01, 0.05])
@pytest.mark.parametrize("columns", [360, 1024])
def test_the_noise_of_ranges_is_measured(sigma: float, columns: int):
    quiet = seen_from(HERE, 0, columns)
    noise = np.random.default_rng(1).normal(0.0, sigma, quiet.shape[:2])
    exact = np.linalg.norm(quiet, axis=-1) - np.random.default_rng(0).normal(0.0, 0.01, quiet.shape[:2])
    missed = misses_of((exact + noise)[..., None] * beams(columns))
    assert np.nanmedian(np.abs(missed)) / 0.6745 == pytest.approx(sigma, rel=0.08)


def test_planes_of_a_room(room: Path, capsys: pytest.CaptureFixture[str]):
    code, out, _ = run(capsys, "fit", room, "--json", "--min-points", 500)
    assert code == 0
    answer = json.loads(out)
    # 1 cm along the beams is less along the normals, on slanted walls the most
    assert 0.007 < answer["sigma_m"] < 0.0105 and answer["sigma_note"].startswith("measured")
    assert answer["octave_sigma_m"] < 0.0005 and answer["warnings"] == [] and len(answer["planes"]) == 6
    for plane in answer["planes"]:
        normal, d = HERE[:3, :3] @ plane["normal"], plane["d"] + (HERE[:3, :3] @ plane["normal"]) @ HERE[:3, 3]
        assert abs(d + ROOM[int(np.abs(normal).argmax())]) < 5.0 * plane["sigma_d_m"] + 0.002
        assert plane["sigma_tilt_deg"] < 0.2 and plane["area_m2"] > 4.0
    counts = [plane["n_points"] for plane in answer["planes"]]
    assert counts == sorted(counts, reverse=True)


def test_a_stated_sigma_is_used_and_the_table_says_so(room: Path, capsys: pytest.CaptureFixture[str]):
    code, out, _ = run(capsys, "fit", room, "--sigma", 0.02)
    assert code == 0 and "Zimmer [7] Süd.npy, points of 20 mm" in out and "as given" in out
    assert "expected a standard deviation above 0" in refused(capsys, "fit", room, "--sigma", -1)


def test_what_fit_leaves(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run(capsys, "fit", room, "--out", tmp_path / "found", "--min-points", 500)[0] == 0
    left = {path.name for path in (tmp_path / "found").iterdir()}
    assert left == {"planes.json", "planes.ply", "planes.png", "points.ply"}
    assert len(read_planes(tmp_path / "found" / "planes.json")) == 6
    points = read_tables(tmp_path / "found" / "points.ply")["vertex"]
    assert len(points) == 32 * 360 and set(np.unique(points["plane"])) - {-1} == set(range(6))
    assert "exists already" in refused(capsys, "fit", room, "--out", tmp_path / "found")
    # what it wrote is a cloud again
    assert len(read_cloud(tmp_path / "found" / "points.ply").points) == 32 * 360


def test_planes_are_in_the_frame_of_the_file():
    found = fit_cloud(Cloud(seen_from(HERE, 5), HERE), Path("x")).at_least(500)
    for plane in found.planes:
        axis = int(np.abs(plane.normal).argmax())
        assert abs(plane.normal[axis]) > 0.9999 and plane.d == pytest.approx(-ROOM[axis], abs=0.005)
        assert np.abs(plane.distance(found.points[found.labels == found.planes.index(plane)])).max() < 0.06
    np.testing.assert_allclose(found.viewpoint, HERE[:3, 3])


def test_nothing_to_fit(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "two.xyz").write_text("1 2 3\n4 5 6\n")
    assert "two.xyz: expected at least three points, got fewer" in refused(capsys, "fit", tmp_path / "two.xyz")
    (tmp_path / "three.xyz").write_text("1 2 3\n4 5 6\n1 0 1\n")
    code, out, err = run(capsys, "fit", tmp_path / "three.xyz")
    assert code == 0 and "no planes of 30 points" in err and "assumed" in out
    with pytest.raises(LogError):
        fit_cloud(Cloud(np.full((5, 3), np.nan)), Path("x"))


def test_every_point_is_counted_once(room: Path, capsys: pytest.CaptureFixture[str]):
    cloud = np.load(room).reshape(-1, 3)
    whole = np.concatenate((cloud, np.full((7, 3), np.nan), np.zeros((3, 3))))
    counts = fit_cloud(Cloud(np.random.default_rng(2).permutation(whole)), Path("x")).at_least(500).counts
    assert counts.total == len(whole) and counts.no_return == 10
    assert counts.on_planes + counts.on_no_plane + counts.edge_on == counts.returns == len(cloud)
    assert counts.on_planes > 0.95 * len(cloud)
    code, out, _ = run(capsys, "fit", room, "--json")
    told = json.loads(out)["points"]
    assert code == 0 and told["total"] == sum(value for name, value in told.items() if name != "total")


def test_planes_seen_edge_on_and_of_the_sensors_housing_are_flagged():
    found = fit_cloud(read_cloud(needs("pcl_room") / "room_scan1.pcd"), Path("x"))
    least = np.cos(ValidationConfig().max_incidence_rad)
    edge_on = [abs(one.distance([0, 0, 0])) < least * np.linalg.norm(one.centre) for one in found.planes]
    assert edge_on == [flag == "edge-on" for flag in found.flags]
    near = [one for one, flag in zip(found.planes, found.flags, strict=True) if flag == "too near"]
    assert near and all(np.linalg.norm(one.centre) < 0.4 for one in near)  # its housing is 0.12 m away


def test_an_unordered_camera_cloud_keeps_the_middle_of_the_wall():
    """z ahead: the pole of a range image round z would be in the middle of the picture."""
    u, v = np.meshgrid(np.linspace(-0.55, 0.55, 200), np.linspace(-0.42, 0.42, 150))
    points = np.stack((u, v, np.ones_like(u)), axis=-1).reshape(-1, 3) * 2.0
    points += np.random.default_rng(5).normal(0.0, 0.002, points.shape)
    found = fit_cloud(Cloud(points[np.random.default_rng(6).permutation(len(points))]), Path("x"), sigma_m=0.004)
    assert len(found.at_least(500).planes) == 1 and found.counts.on_planes > 0.99 * len(points)
    middle = np.hypot(found.points[:, 0], found.points[:, 1]) < 0.2
    assert middle.sum() > 400 and (found.labels[middle] == 0).mean() > 0.99
    assert found.planes[0].outline.area == pytest.approx(2.2 * 1.68, rel=0.05)
