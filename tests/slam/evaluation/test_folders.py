"""Whole runs against whole truths, on disk; planes.json."""

import numpy as np
import pytest

from slam.errors import LogError
from slam.evaluation import compare_with_truth
from slam.geometry.frames import planar_transform
from slam.io.clouds.depth import CAMERA_MOUNT
from slam.io.default_rigs import depth_rig
from slam.io.planes_json import read_planes, write_planes
from slam.io.trajectories import Trajectory, read_tum, write_tum
from slam.sensors.rig import Mount, Rig
from slam.simulation import VERTICAL, simulate_mission
from spplanes import Plane
from spplanes.spmodel import transform_from_rpy


def values_of(found):
    """Of all that was scored, by name."""
    return {row.name: row.value for row in found.rows}


@pytest.fixture(scope="module")
def mission():
    return simulate_mission("corridor", n_scans=120, seed=9)


def run_of(folder, mission, moved):
    """A run that got everything right, in a world of its own."""
    folder.mkdir()
    stamps = np.array([scan.stamp_ns for scan in mission.log.scans(VERTICAL)][::10])
    write_tum(folder / "trajectory.tum", Trajectory(stamps, moved @ mission.truth.poses_at(stamps)))
    planes = [mission.truth.planes[k].transform(moved) for k in sorted(mission.truth.visible_in_3d())]
    write_planes(folder / "planes.json", [Plane(p.frame, 1e-6 * np.eye(3), outline=p.outline) for p in planes])
    odometry = {reading.stamp_ns: reading.odom_T_body for reading in mission.log.odometry}
    write_tum(folder / "odometry.tum", Trajectory(np.array(list(odometry)), np.array(list(odometry.values()))))
    return folder


def test_a_perfect_run_scores_perfectly_wherever_its_world_lies(mission, tmp_path):
    mission.save(tmp_path / "mission")
    run = run_of(tmp_path / "run", mission, planar_transform(5.0, -3.0, 2.0))
    for truth in (tmp_path / "mission", tmp_path / "mission" / "truth"):
        values = values_of(compare_with_truth(run, truth))
        assert values["ATE translation max"] < 1e-9 and values["RPE over 1 m translation max"] < 1e-9
        assert values["planes missed"] == values["planes duplicate"] == values["planes invented"] == 0.0
        assert values["plane angle max"] < 1e-5 and values["plane distance max"] < 1e-9
        assert values["odometry alone: ATE from the first pose, translation rmse"] > 1e-3
    values = values_of(compare_with_truth(run, tmp_path / "mission" / "truth" / "trajectory.tum"))
    assert values["ATE rotation max"] < 1e-5 and "planes missed" not in values


def test_poses_at_every_scan_are_scored_where_the_run_has_them(mission, tmp_path):
    """Keyframes are every tenth scan: of relations between other scans none was found, of poses a tenth."""
    run = run_of(tmp_path / "run", mission, np.eye(4))
    stamps = np.array([scan.stamp_ns for scan in mission.log.scans(VERTICAL)])
    poses = mission.truth.poses_at(stamps)
    with (tmp_path / "my.relations").open("w") as stream:
        for a, b in ((1, 12), (5, 44), (10, 20)):
            pose = np.linalg.inv(poses[a]) @ poses[b]
            yaw = np.arctan2(pose[1, 0], pose[0, 0])
            stream.write(f"{stamps[a] / 1e9:.9f} {stamps[b] / 1e9:.9f} {pose[0, 3]} {pose[1, 3]} 0 0 0 {yaw}\n")
    write_tum(tmp_path / "truth.tum", Trajectory(stamps, poses))
    before = compare_with_truth(run, tmp_path / "my.relations")
    assert before.notes == ["scored 1 of 3 relations, by trajectory.tum"]
    note = compare_with_truth(run, tmp_path / "truth.tum").notes[0]
    assert note == f"compared 12 of 12 poses of the run (trajectory.tum) with {len(stamps)} of the truth"
    write_tum(run / "scans.tum", Trajectory(stamps, poses))
    after = compare_with_truth(run, tmp_path / "my.relations")
    assert after.notes == ["scored 3 of 3 relations, by scans.tum"]
    assert values_of(after)["relations translation max"] < 1e-6
    found = compare_with_truth(run, tmp_path / "truth.tum")
    assert any(one.startswith("odometry alone errs by") and "more than the estimate" in one for one in found.notes)
    rows = values_of(found)
    assert rows["poses compared"] == rows["poses of the run"] == rows["poses of the truth"] == len(stamps)
    assert "odometry alone: poses compared" in rows


def test_a_truth_of_other_times_is_refused_and_taken_by_row_only_when_asked(mission, tmp_path):
    run = run_of(tmp_path / "run", mission, np.eye(4))
    (run / "odometry.tum").unlink()
    path = read_tum(run / "trajectory.tum")
    off = tmp_path / "off.tum"
    write_tum(off, Trajectory(path.stamps_ns + 500_000 * 10**9, path.poses))
    message = r"truth: expected times in common with the estimate \(12 poses from 1000\.\d+"
    with pytest.raises(ValueError, match=message):
        compare_with_truth(run, off)
    found = compare_with_truth(run, off, by_row=True)
    assert found.notes[0] == "off.tum was taken row by row, whatever its times"
    assert values_of(found)["ATE translation max"] < 1e-9
    write_tum(off, Trajectory(path.stamps_ns[:5], path.poses[:5]))
    with pytest.raises(ValueError, match=r"off\.tum: expected, by row, as many poses as the run's 12, got 5"):
        compare_with_truth(run, off, by_row=True)
    (tmp_path / "my.relations").write_text("1 2 0 0 0 0 0 0\n")
    with pytest.raises(ValueError, match="expected a TUM trajectory where rows"):
        compare_with_truth(run, tmp_path / "my.relations", by_row=True)


def test_few_poses_are_said_and_turn_no_rotation(tmp_path):
    """Five poses on a line leave the turn about it open to positions alone: it was 144 deg without a word."""
    (tmp_path / "run").mkdir()

    def compared(count):
        true = np.array([planar_transform(0.3 * k, 0.0, 0.1 * k) for k in range(count)])
        seen, stamps = true.copy(), np.arange(count) * 10**9
        seen[:, :3, 3] += 1e-3 * np.random.default_rng(0).standard_normal((count, 3))
        write_tum(tmp_path / "run" / "trajectory.tum", Trajectory(stamps, seen))
        write_tum(tmp_path / "truth.tum", Trajectory(stamps, true))
        return compare_with_truth(tmp_path / "run", tmp_path / "truth.tum")

    found = compared(5)
    rows = values_of(found)
    assert rows["ATE rotation max"] < 0.5 and rows["ATE translation max"] < 3e-3
    few = "few poses: alignment takes 6 of their 15 coordinates, the errors themselves are known to 24 % only"
    assert found.notes[1] == few and len(compared(40).notes) == 1


def camera_run(folder, body_T_camera):
    """A run of a depth camera that got everything right, and the truth of its camera."""
    (run := folder / "run").mkdir()
    stamps = np.arange(40) * 10**9
    body = np.array([planar_transform(2.0 * np.sin(0.2 * k), 0.3 * k, 0.2 * k) for k in range(40)])
    write_tum(run / "trajectory.tum", Trajectory(stamps, body))
    camera = depth_rig().sensors["camera"].model_copy(update={"mount": Mount(matrix=tuple(map(tuple, body_T_camera)))})
    Rig(sensors={"camera": camera}).to_yaml(run / "rig.yaml")
    for name in ("depth", "truth"):
        (folder / "images" / name).mkdir(parents=True)
    (folder / "images" / "intrinsics.txt").write_text("525 525 320 240\n")
    (folder / "images" / "depth" / "1.png").write_bytes(b"")
    return run, Trajectory(stamps, planar_transform(1.0, 2.0, 0.4) @ body @ body_T_camera)


@pytest.mark.parametrize("place", ["images", "images/truth"])
def test_groundtruth_beside_depth_images_is_of_the_camera(tmp_path, place):
    """x right, y down, z forward against x forward, y left, z up: axes compared as they are, 120 deg of error."""
    run, truth = camera_run(tmp_path, transform_from_rpy((0.2, -0.1, 1.1, 0.0, 0.0, 0.0)) @ CAMERA_MOUNT)
    file = tmp_path / place / "groundtruth.txt"
    write_tum(file, truth)
    found = compare_with_truth(run, file)
    rows = values_of(found)
    assert rows["ATE rotation max"] < 1e-4 and rows["ATE translation max"] < 1e-9
    moved = "groundtruth.txt is of the sensor 'camera': moved to the body by the mount in the run's rig"
    assert found.notes[0] == moved
    as_body = values_of(compare_with_truth(run, file, truth_of="body"))
    assert as_body["ATE from the first pose, rotation max"] > 20.0


def test_whose_poses_a_truth_has_can_be_said(tmp_path):
    run, truth = camera_run(tmp_path, CAMERA_MOUNT)
    write_tum(tmp_path / "mocap.tum", truth)
    for told in ("sensor", "camera"):
        found = compare_with_truth(run, tmp_path / "mocap.tum", truth_of=told)
        assert values_of(found)["ATE rotation max"] < 1e-4
    assert values_of(compare_with_truth(run, tmp_path / "mocap.tum"))["ATE rotation max"] > 20.0
    with pytest.raises(ValueError, match=r"truth_of: expected 'body', 'sensor' or one of .* \(camera\), got 'lidar'"):
        compare_with_truth(run, tmp_path / "mocap.tum", truth_of="lidar")
    (run / "rig.yaml").unlink()
    with pytest.raises(LogError, match=r"rig\.yaml: expected the rig of the run, found none"):
        compare_with_truth(run, tmp_path / "mocap.tum", truth_of="sensor")


def test_missing_truths_and_runs_are_named(mission, tmp_path):
    run = run_of(tmp_path / "run", mission, np.eye(4))
    with pytest.raises(LogError, match="nowhere: expected a mission's folder"):
        compare_with_truth(run, tmp_path / "nowhere")
    with pytest.raises(LogError, match=r"run2/trajectory\.tum: cannot be read"):
        compare_with_truth(tmp_path / "run2", run / "trajectory.tum")
    with pytest.raises(LogError, match=r"trajectory\.tum: cannot be read|labels\.npz: cannot be read"):
        compare_with_truth(run, run)


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
