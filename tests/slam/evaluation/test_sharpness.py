"""Sharpness: thin walls by true poses, thicker ones by poses that are off, and only planes that several scans share."""

import json
from pathlib import Path

import numpy as np
import pytest

from slam.evaluation import compare_sharpness
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory, write_tum
from spplanes.spmodel import transform_from_rpy
from tests.slam.commands import command, refused


def scans_of_a_room(n: int, noise_m: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Points on floor and two walls of 6 m, in the frames of bodies in it, and their poses."""
    rng = np.random.default_rng(5)
    clouds, poses = [], np.tile(np.eye(4), (n, 1, 1))
    for k in range(n):
        poses[k] = transform_from_rpy((2.0 + 0.3 * k, 2.0, 1.0, 0.4 * k, 0.0, 0.0))
        world = np.concatenate([np.insert(rng.uniform(0.0, 6.0, (4000, 2)), axis, 0.0, axis=1) for axis in range(3)])
        world += rng.normal(0.3, noise_m, world.shape)
        body = inverse(poses[k])
        clouds.append(world @ body[:3, :3].T + body[:3, 3])
    return clouds, poses


def moved(poses: np.ndarray) -> np.ndarray:
    """The third of them 5 cm off."""
    wrong = poses.copy()
    wrong[2, :3, 3] += 0.05
    return wrong


def test_true_poses_leave_the_noise_and_wrong_ones_more():
    clouds, poses = scans_of_a_room(4, 0.01)
    found = compare_sharpness(clouds, poses + 0.0, moved(poses))
    assert found.estimate_m == pytest.approx(0.6745 * 0.01, rel=0.1)  # median of a normal deviate's size
    assert found.reference_m > 1.5 * found.estimate_m
    assert found.cells >= 50


def test_of_a_plane_along_the_face_of_a_cube_or_that_less_than_three_scans_share_there_is_nothing_to_say():
    clouds, poses = scans_of_a_room(4, 0.01)
    poses[:, :3, 3] -= 0.3  # to where the cubes begin
    assert np.isnan(compare_sharpness(clouds, poses, poses).estimate_m)
    clouds, poses = scans_of_a_room(2, 0.01)
    found = compare_sharpness(clouds, poses, poses)
    assert found.cells == 0 and np.isnan(found.estimate_m)
    with pytest.raises(ValueError, match="poses: expected 2, one a cloud, got 1 and 2"):
        compare_sharpness(clouds, poses[:1], poses)


def test_neither_world_matters():
    clouds, poses = scans_of_a_room(3, 0.01)
    elsewhere = transform_from_rpy((100.0, 3.0, -7.0, np.pi / 2.0, 0.0, 0.0))
    found = compare_sharpness(clouds, poses, elsewhere @ poses)
    assert found.reference_m == pytest.approx(found.estimate_m, rel=1e-9)


def test_a_run_is_as_sharp_as_its_clouds_say(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    clouds, poses = scans_of_a_room(4, 0.01)
    wrong = moved(poses)
    log, run, stamps = tmp_path / "log", tmp_path / "run", np.arange(4) * 10**9
    log.mkdir(), run.mkdir()
    for k, cloud in enumerate(clouds):
        np.save(log / f"{k:03d}.npy", cloud)
    write_tum(run / "trajectory.tum", Trajectory(stamps, wrong))
    write_tum(tmp_path / "truth.tum", Trajectory(stamps + 10**15, poses))  # in order: other times
    (run / "metrics.json").write_text('{"metrics": []}')
    options = ["evaluate", run, "--truth", tmp_path / "truth.tum", "--clouds", log, "--json", "--by-row"]
    assert command(*options) == 0
    rows = {row["metric"]: row["value"] for row in json.loads(capsys.readouterr().out)}
    assert rows["sharpness by the reference"] == pytest.approx(0.6745 * 0.01, rel=0.1)
    assert rows["sharpness, median point to plane"] > 1.5 * rows["sharpness by the reference"]
    assert rows["ATE translation max"] > 0.03
    write_tum(run / "trajectory.tum", Trajectory(stamps + 5 * 10**8, wrong))
    assert "expected 3D scans at the times of the run's poses, found none" in refused(capsys, *options)
