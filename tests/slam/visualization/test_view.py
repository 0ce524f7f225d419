"""Pictures, page and recording of a run, from its folder alone."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from shapely import LinearRing, Polygon, box

from slam.config import SlamConfig
from slam.io.planes_json import write_planes
from slam.io.trajectories import Trajectory, write_tum
from slam.map.map_planes import MapPlane
from slam.output.run_files import as_json, write_json, write_run
from slam.runs.history import History
from slam.runs.slam_run import run_slam
from slam.runs.stored_run import StoredRun
from slam.sensors.log import CloudScan, Log
from slam.simulation import simulate_mission
from slam.visualization.open3d_export import planes_to_mesh, vertex_sigmas
from slam.visualization.pictures import draw_view, position_covariances
from slam.visualization.report import view_run
from spplanes import Plane
from spplanes.spmodel import transform_from_rpy
from tests.slam.commands import command, refused
from tests.slam.visualization.test_open3d_export import moving, two_planes
from tests.slam.visualization.test_report import stored

try:
    import rerun
except ImportError:
    rerun = None


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run's folder: what `stored` of the page's tests holds, and covariances of poses."""
    folder, given = tmp_path / "run ü", stored()
    folder.mkdir()
    write_planes(folder / "planes.json", given.planes)
    write_tum(folder / "trajectory.tum", given.trajectory)
    write_tum(folder / "odometry.tum", given.odometry)
    write_json(folder / "metrics.json", {"metrics": as_json(given.tables[0][1])})
    covariances = {k: np.diag([1e-4, 4e-4, 1e-6, 1e-6, 1e-6, 1e-6]) for k in (0, 15, 29)}
    history = replace(History.of(given.planes), nis=given.history.nis, pose_covariances=covariances)
    history.write(folder / "view.json")
    return folder


def test_pictures_and_page_from_the_folder_alone(run: Path, tmp_path: Path, capsys):
    kept = {path.name: path.read_bytes() for path in run.iterdir()}
    assert command("view", run, "--out", tmp_path / "out") == 0
    assert {path.name: path.read_bytes() for path in run.iterdir()} == kept
    names = ["plan.png", "side.png", "uncertainty.png", "report.html"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == sorted(names)
    assert capsys.readouterr().out.split("\n")[:4] == [str(tmp_path / "out" / name) for name in names]
    for name in names[:3]:
        pixels = imread(tmp_path / "out" / name)
        assert len(np.unique(np.rint(255.0 * pixels) @ 256.0 ** np.arange(pixels.shape[2]))) > 20, name
    assert command("view", run) == 0
    for name in names[:3]:
        assert (run / name).read_bytes() == (tmp_path / "out" / name).read_bytes()
    assert "run ü" in (run / "report.html").read_text()


def test_ellipses_are_turned_into_the_world():
    given = stored()
    turned = given.trajectory.poses @ transform_from_rpy((0.0, 0.0, 0.0, np.pi / 2, 0.0, 0.0))
    history = History(pose_covariances={3: np.diag([1.0, 4.0, 9.0, 1.0, 1.0, 1.0]), 1000: np.eye(6)})
    run = replace(given, trajectory=Trajectory(given.trajectory.stamps_ns, turned), history=history)
    places, covariances = position_covariances(run, run.history)
    np.testing.assert_array_equal(places, turned[[3], :3, 3])
    np.testing.assert_allclose(covariances, [np.diag([4.0, 1.0, 9.0])], atol=1e-12)


def test_older_folders_and_empty_maps_are_drawn(tmp_path: Path):
    for name, planes in (("old", two_planes()), ("empty", [])):
        folder = tmp_path / name
        folder.mkdir()
        write_planes(folder / "planes.json", planes)
        write_tum(folder / "trajectory.tum", moving(2, 0.0))
        assert len(view_run(folder)) == 4


def test_a_run_without_odometry_is_written_and_read(tmp_path: Path):
    """Clouds alone: there is no odometry to write, and an empty file would be none."""
    mission = simulate_mission("hall", n_scans=2, seed=0)
    clouds = [event for event in mission.log.events if isinstance(event, CloudScan)]
    run = run_slam(Log(clouds, Path("clouds")), mission.rig, SlamConfig())
    (tmp_path / "run").mkdir()
    write_run(run, tmp_path / "run", title="clouds")
    assert not (tmp_path / "run" / "odometry.tum").exists()
    assert len(StoredRun.read(tmp_path / "run").odometry) == 0
    assert len(view_run(tmp_path / "run")) == 4


def test_deviation_knows_the_signs_of_the_cross_terms():
    """z = p_z - theta x + psi y: with z and theta fully correlated the plane pivots about x = 1, not x = -1."""
    plane = Plane(np.eye(4), np.outer([1e-3, 1e-3, 0.0], [1e-3, 1e-3, 0.0]), 10)
    mesh = SimpleNamespace(vertices=np.array([[1.0, 5.0, 0.0], [-1.0, 5.0, 0.0]]), plane_ids=np.zeros(2, np.int32))
    sigmas = vertex_sigmas([MapPlane(0, plane, box(-1, -1, 1, 1), 1, ("plane",))], mesh)
    np.testing.assert_allclose(sigmas, [0.0, 2e-3], atol=1e-12)


def test_without_open3d_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match=r"pip install spplanes\[open3d\].*libusb-1.0"):
        planes_to_mesh([])


@pytest.mark.skipif(rerun is None, reason="rerun is not installed: pip install spplanes[rerun]")
def test_the_recording_has_the_entities(run: Path, tmp_path: Path):
    """Read by Rerun's own reader."""
    target = tmp_path / "run.rrd"
    assert command("view", run, "--out", tmp_path / "out", "--rerun", target) == 0
    tool = [sys.executable, "-m", "rerun", "rrd"]
    alone = {**os.environ, "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path), "RERUN_TELEMETRY": "0"}
    subprocess.run([*tool, "verify", str(target)], check=True, capture_output=True, env=alone)
    printed = [*tool, "print", "-vv", str(target)]
    shown = subprocess.run(printed, check=True, capture_output=True, text=True, env=alone).stdout
    map_, of_the_way = ("/map/plane_7 ", "/map/plane_8/outline"), ("/trajectory", "/odometry", "/body", "/confidence")
    for entity in (*map_, *of_the_way, "/nis/plane"):
        assert entity in shown, entity
    assert "Mesh3D:vertex_positions" in shown and "keyframe" in shown


def test_without_rerun_the_sentence_says_what_to_install(run: Path, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install spplanes[rerun]" in refused(capsys, "view", run, "--rerun", tmp_path / "run.rrd")
    assert not (tmp_path / "run.rrd").exists()


def test_the_side_view_shows_true_silhouettes():
    """A wall that one sees nearly edge-on from the side is the polygon that it projects to, not a stroke across it."""
    frame = np.eye(4)
    turn = np.deg2rad(20.0)  # the wall runs at 20 deg to the line of sight, which is along y
    along, normal = np.array([np.sin(turn), np.cos(turn), 0.0]), np.array([np.cos(turn), -np.sin(turn), 0.0])
    frame[:3, :3] = np.column_stack((along, np.cross(normal, along), normal))
    seen = box(-3.0, -1.0, 3.0, 1.0).difference(box(-0.5, -0.5, 0.5, 0.5))
    plane = MapPlane(0, Plane(frame, np.diag([1e-6] * 3), 10, seen), seen, 2, ("plane",))
    axes = Figure().subplots()
    draw_view(axes, StoredRun(Path(), [plane], Trajectory.empty(), Trajectory.empty(), History(), []), "side")
    (outlines, strokes) = axes.collections
    (path,) = outlines.get_paths()
    outer, hole = path.to_polygons()
    half = 3.0 * np.sin(turn)
    np.testing.assert_allclose(Polygon(outer).symmetric_difference(box(-half, -1.0, half, 1.0)).area, 0.0, atol=1e-9)
    assert Polygon(hole).area == pytest.approx(1.0 * np.sin(turn))
    assert LinearRing(hole).is_ccw != LinearRing(outer).is_ccw  # what winds the other way is left open
    assert not strokes.get_paths() and outlines.get_linewidths()[0] < 1.0
