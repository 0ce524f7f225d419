"""Simulated missions with truth, poses unknown: better than odometry, and honest about poses and planes."""

from pathlib import Path

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.evaluation import absolute_error, match_planes
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory, read_tum
from slam.output.run_files import write_run
from slam.output.run_metrics import in_frame_of_truth
from slam.planeslam import pose_symbol
from slam.runs.slam_run import Run, run_slam
from slam.simulation import Mission, simulate_mission
from tests.slam.scenes import planar_nees
from tests.statistics import assert_mean_in_band

SEEDS = range(4)


@pytest.fixture(scope="module")
def missions() -> list[tuple[Mission, Run]]:
    made = [simulate_mission("corridor", n_scans=200, seed=seed) for seed in SEEDS]
    return [(mission, run_slam(mission.log, mission.rig, SlamConfig())) for mission in made]


def rmse(path: Trajectory, mission: Mission) -> float:
    errors = absolute_error(path, mission.truth.trajectory, alignment="first").translation_m
    return float(np.sqrt(np.mean(errors**2)))


def test_positions_are_a_fraction_of_the_odometrys_error(missions: list[tuple[Mission, Run]]):
    estimate = [rmse(run.trajectory, mission) for mission, run in missions]
    odometry = [rmse(run.odometry, mission) for mission, run in missions]
    assert np.median(estimate) < 0.25 * np.median(odometry) and max(estimate) < 0.01


def test_pose_nees_is_in_its_band(missions: list[tuple[Mission, Run]]):
    values = []
    for mission, run in missions:
        true, poses = mission.truth.poses_at(run.trajectory.stamps_ns), run.trajectory.poses
        covariance = run.slam.marginal_covariance(pose_symbol(len(true) - 1))
        values.append(planar_nees(covariance, inverse(true[0]) @ true[-1], inverse(poses[0]) @ poses[-1]))
    assert_mean_in_band(np.array(values), 3)


def test_map_planes_are_honest_single_and_right(missions: list[tuple[Mission, Run]]):
    """Most planes of one run share poses, so the band is wide; a mixture of two surfaces would be in the hundreds."""
    for mission, run in missions:
        planes = list(in_frame_of_truth(run, mission.truth.trajectory).values())
        matches = match_planes(planes, mission.truth.planes)
        assert len(matches) == len(planes), "an invented plane"
        assert len({match.true for match in matches}) >= len(matches) - 1
        assert 0.5 < np.mean([match.nees for match in matches]) < 9.0
        assert np.median([abs(match.distance_m) for match in matches]) < 0.002


def test_the_audit_finds_the_measurements_about_as_far_off_as_they_say(missions: list[tuple[Mission, Run]]):
    """Not one by one: planes of a window share the odometry's error, which the pose takes for its own and lines see.

    Windows are placed by laser odometry and stated to err as wheels do, by more: planes are cautious.
    """
    rows = [row for _, run in missions for row in run.slam.audit.summary()]
    for kind in ("line", "plane"):
        means = [row.mean_per_dof for row in rows if row.kind == kind]
        assert (0.8 if kind == "line" else 0.6) < np.mean(means) < 1.2
    assert [row.verdict for row in rows].count("over-confident") <= 2


@pytest.mark.parametrize("number", [1, 2])
def test_its_stamps_are_those_of_the_log_and_the_files_say_the_same(
    number: int, missions: list[tuple[Mission, Run]], tmp_path: Path
):
    mission, run = missions[number]
    expected = sorted({scan.stamp_ns for scan in mission.log.scans()})
    assert run.scan_trajectory.stamps_ns.tolist() == expected
    places = np.searchsorted(run.scan_trajectory.stamps_ns, run.trajectory.stamps_ns)
    np.testing.assert_array_equal(run.scan_trajectory.poses[places], run.trajectory.poses)
    np.testing.assert_allclose(run.scan_odometry.poses[places], run.odometry.poses, atol=1e-9)
    write_run(run, tmp_path, title="mission")
    written = read_tum(tmp_path / "scans.tum")
    assert written.stamps_ns.tolist() == expected
    np.testing.assert_allclose(written.poses, run.scan_trajectory.poses, atol=1e-12)
    assert read_tum(tmp_path / "odometry.tum").stamps_ns.tolist() == expected
