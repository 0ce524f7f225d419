"""Clouds without any odometry: poses found by planes alone, in a real hall and in one that looks alike everywhere."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.evaluation import absolute_error, compare_sharpness
from slam.io.load import load
from slam.io.trajectories import Trajectory, read_tum
from slam.planeslam import pose_symbol
from slam.runs.slam_run import Run, run_slam
from slam.sensors.log import CloudScan
from slam.simulation import simulate_mission
from tests.slam.real_data import needs


@pytest.fixture(scope="module")
def hall() -> Run:
    return run_slam(*load(needs("balm_hall/000.pcd").parent), SlamConfig())


def test_a_hall_without_odometry_is_where_lidar_odometry_has_it(hall: Run):
    """20 clouds, 1.5 s apart, turns of up to 60 deg between two of them; the reference: 1-2 cm and 0.1 deg."""
    reference = read_tum(needs("balm_hall/lidar_odometry.tum"))
    errors = absolute_error(hall.trajectory, Trajectory(hall.trajectory.stamps_ns, reference.poses))
    assert errors.translation_m.max() < 0.05 and np.rad2deg(errors.rotation_rad.max()) < 0.4


@pytest.mark.parametrize(
    "far_m, noise_m, kept",
    [(10.0, 0.0, 1.0), (200.0, 0.03, 1.0), (200.0, 0.0, 0.2)],
    ids=["near", "noisy", "mostly holes"],
)
def test_a_hall_seen_in_part_is_where_it_is_seen_whole(far_m: float, noise_m: float, kept: float):
    """A body that stood, and then turns by 60 deg, is where what it sees fits, not near where it was expected."""
    log, rig = load(needs("balm_hall/000.pcd").parent)
    rng = np.random.default_rng(0)

    def poorer(cloud: CloudScan) -> CloudScan:
        points = np.array(cloud.points)
        ranges = np.linalg.norm(points, axis=-1, keepdims=True)
        points *= 1.0 + noise_m * rng.standard_normal(ranges.shape) / np.maximum(ranges, 0.1)
        seen = (ranges < far_m) & (rng.random(ranges.shape) < kept)
        return replace(cloud, points=np.where(seen, points, np.nan))

    scans = [CloudScan(one.stamp_ns, one.sensor, one.points) for one in log.scans() if isinstance(one, CloudScan)]
    run = run_slam(replace(log, events=[poorer(one) for one in scans]), rig, SlamConfig(), repair=False)
    reference = read_tum(needs("balm_hall/lidar_odometry.tum"))
    errors = absolute_error(run.trajectory, Trajectory(run.trajectory.stamps_ns, reference.poses))
    assert errors.translation_m.max() < 0.05 and np.rad2deg(errors.rotation_rad.max()) < 0.4
    assert run.verdict.verdict == "sound"


def test_the_halls_map_is_as_sharp_as_with_the_poses_of_lidar_odometry(hall: Run):
    """Median distance of points from the planes that at least three clouds share, to 3 %."""
    reference = read_tum(needs("balm_hall/lidar_odometry.tum"))
    clouds = [cloud.points.reshape(-1, 3)[::7] for cloud in hall.log.scans() if isinstance(cloud, CloudScan)]
    found = compare_sharpness(clouds, hall.trajectory.poses, reference.poses)
    assert found.cells > 300 and found.estimate_m < 1.03 * found.reference_m


def test_the_hall_says_that_nothing_measured_its_motion(hall: Run):
    assert all(frame.motion is None for frame in hall.slam.keyframes)
    assert all("constant velocity" in stretch.sentence for stretch in hall.slam.open_directions)


@cache
def without_odometry(seed: int, *chosen: int) -> tuple[Run, np.ndarray, np.ndarray]:
    """A run over some of the scans, a slice, and how far off its poses are from the first on, m and rad."""
    whole = simulate_mission("hall", n_scans=83, seed=seed)
    scans = [event for event in whole.log.events if isinstance(event, CloudScan)][slice(*chosen)]
    run = run_slam(replace(whole.log, events=scans), whole.rig, SlamConfig())
    true = Trajectory(run.trajectory.stamps_ns, whole.truth.poses_at(run.trajectory.stamps_ns))
    errors = absolute_error(run.trajectory, true, alignment="first")
    return run, errors.translation_m, errors.rotation_rad


@pytest.mark.parametrize("seed", [30, 33])
def test_a_pillar_is_not_taken_for_the_next_where_the_way_along_them_is_open(seed: int):
    """Where at one of these scans only walls along the way and pillars are seen, nobody knows where along it it was."""
    run, positions, _ = without_odometry(seed, 70, 82)
    covariances = [run.slam.marginal_covariance(pose_symbol(k)) for k in range(len(positions))]
    sigmas = np.array([np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]) for covariance in covariances])
    assert np.all(positions < np.maximum(3.0 * sigmas, 0.01))
    named = {keyframe for stretch in run.slam.open_directions for keyframe in stretch.keyframes}
    assert named >= set(np.flatnonzero(sigmas > 0.01).tolist()) and np.count_nonzero(sigmas > 0.01) <= 1


@pytest.mark.parametrize("seed", [50, 55])
def test_a_pillar_is_not_taken_for_the_next_where_the_robot_drove_on(seed: int):
    """Three seconds without a scan, and nothing but scans: at the fifth the next pillar fits about as well."""
    _, positions, _ = without_odometry(seed, 62, 83, 3)
    assert positions.max() < 0.01
