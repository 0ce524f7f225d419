"""Whole runs against whole truths, on disk; planes.json."""

import json

import numpy as np
import pytest
from shapely import box

from slam.errors import LogError
from slam.evaluation import evaluate_run
from slam.geometry.frames import planar_transform
from slam.io.planes_json import read_planes, write_planes
from slam.io.trajectories import Trajectory, write_tum
from slam.simulation import VERTICAL, simulate_mission
from spplanes import Plane


@pytest.fixture(scope="module")
def mission():
    return simulate_mission("corridor", n_scans=120, seed=9)


def run_of(folder, mission, moved):
    """A run that got everything right, in a world of its own."""
    folder.mkdir()
    stamps = np.array([scan.stamp_ns for scan in mission.log.scans(VERTICAL)][::10])
    write_tum(folder / "trajectory.tum", Trajectory(stamps, moved @ mission.truth.poses_at(stamps)))
    visible = sorted(mission.truth.visible_in_3d())
    planes = [mission.truth.planes[k].transform(moved) for k in visible]
    write_planes(folder / "planes.json", [Plane(p.frame, 1e-6 * np.eye(3), outline=p.outline) for p in planes])
    readings = mission.log.odometry
    odometry = Trajectory(np.array([r.stamp_ns for r in readings]), np.array([r.odom_T_body for r in readings]))
    write_tum(folder / "odometry.tum", odometry)
    return folder


def test_a_perfect_run_scores_perfectly_wherever_its_world_lies(mission, tmp_path):
    mission.save(tmp_path / "mission")
    run = run_of(tmp_path / "run", mission, planar_transform(5.0, -3.0, 2.0))
    for truth in (tmp_path / "mission", tmp_path / "mission" / "truth"):
        values = {row.name: row.value for row in evaluate_run(run, truth)}
        assert values["ATE translation max"] < 1e-9 and values["RPE over 1 m translation max"] < 1e-9
        assert values["planes missed"] == values["planes duplicate"] == values["planes invented"] == 0.0
        assert values["plane angle max"] < 1e-5 and values["plane distance max"] < 1e-9
        assert values["odometry alone: ATE from the first pose, translation rmse"] > 1e-3
    values = {row.name: row.value for row in evaluate_run(run, tmp_path / "mission" / "truth" / "trajectory.tum")}
    assert values["ATE rotation max"] < 1e-5 and "planes missed" not in values


def test_relations_are_known_by_their_name(mission, tmp_path):
    run = run_of(tmp_path / "run", mission, np.eye(4))
    stamps = [scan.stamp_ns for scan in mission.log.scans(VERTICAL)]
    pose = np.linalg.inv(mission.truth.poses_at([stamps[0]])[0]) @ mission.truth.poses_at([stamps[50]])[0]
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    line = f"{stamps[0] / 1e9:.9f} {stamps[50] / 1e9:.9f} {pose[0, 3]} {pose[1, 3]} 0 0 0 {yaw}\n"
    (tmp_path / "my.relations").write_text(line)
    values = {row.name: row.value for row in evaluate_run(run, tmp_path / "my.relations")}
    assert values["relations found"] == 1 and values["relations translation mean"] < 1e-6


def test_missing_truths_and_runs_are_named(mission, tmp_path):
    run = run_of(tmp_path / "run", mission, np.eye(4))
    with pytest.raises(LogError, match="nowhere: expected a mission's folder"):
        evaluate_run(run, tmp_path / "nowhere")
    with pytest.raises(LogError, match=r"run2/trajectory\.tum: cannot be read"):
        evaluate_run(tmp_path / "run2", run / "trajectory.tum")
    with pytest.raises(LogError, match=r"trajectory\.tum: cannot be read|labels\.npz: cannot be read"):
        evaluate_run(run, run)


def test_planes_survive_the_file_exactly(tmp_path):
    frame = planar_transform(1.0 / 3.0, 2.0, 0.7)
    outline = box(0.0, 0.0, 3.0, 2.0).difference(box(1.0, 1.0, 2.0, 1.5))
    plane = Plane(frame, np.diag([1e-6, 2e-7, 1.0 / 3e7]), 17, outline)
    write_planes(tmp_path / "planes.json", [plane, Plane(np.eye(4), np.eye(3))])
    back = read_planes(tmp_path / "planes.json")
    np.testing.assert_array_equal(back[0].frame, frame)
    np.testing.assert_array_equal(back[0].covariance, plane.covariance)
    assert back[0].n_points == 17 and back[0].outline.equals(outline) and back[1].outline is None
    entry = json.loads((tmp_path / "planes.json").read_text())["planes"][0]
    assert list(entry) == ["id", "normal", "d", "frame", "covariance", "n_points", "outline", "observations"]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("{", r"p\.json:1: expected JSON"),
        ("[" * 100_000, r"p\.json: expected JSON|p\.json:1: expected JSON"),
        ("[]", "expected the format 'spplanes/1'"),
        ('{"format": "spplanes/2"}', "expected the format 'spplanes/1'"),
        ('{"format": "spplanes/1", "planes": 3}', "expected a list under 'planes'"),
        ('{"format": "spplanes/1", "planes": [{"id": 1}]}', r"planes\[0\]: data: expected the key"),
    ],
)
def test_bad_plane_files(tmp_path, text, sentence):
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(LogError, match=sentence):
        read_planes(tmp_path / "p.json")
