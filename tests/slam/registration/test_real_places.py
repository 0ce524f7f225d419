"""Real clouds without any odometry: poses found by planes alone, against what others made of the same clouds."""

from __future__ import annotations

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.evaluation import absolute_error, compare_sharpness
from slam.io.load import load
from slam.io.trajectories import Trajectory, read_tum
from slam.runs.slam_run import Run, run_slam
from slam.sensors.log import CloudScan
from tests.slam.real_data import needs


@pytest.fixture(scope="module")
def hall() -> Run:
    log, rig = load(needs("balm_hall/000.pcd").parent)
    return run_slam(log, rig, SlamConfig())


def test_a_hall_without_odometry_is_where_lidar_odometry_has_it(hall: Run):
    """20 clouds, 1.5 s apart, turns of up to 60 deg between two of them; the reference: 1-2 cm and 0.1 deg."""
    reference = read_tum(needs("balm_hall/lidar_odometry.tum"))
    same_times = Trajectory(hall.trajectory.stamps_ns, reference.poses)
    errors = absolute_error(hall.trajectory, same_times)
    assert errors.translation_m.max() < 0.05
    assert np.rad2deg(errors.rotation_rad.max()) < 0.4


def test_the_halls_map_is_as_sharp_as_with_the_poses_of_lidar_odometry(hall: Run):
    """Median distance of points from the planes that at least three clouds share, to 3 %."""
    reference = read_tum(needs("balm_hall/lidar_odometry.tum"))
    clouds = [cloud.points.reshape(-1, 3)[::7] for cloud in hall.log.scans() if isinstance(cloud, CloudScan)]
    found = compare_sharpness(clouds, hall.trajectory.poses, reference.poses)
    assert found.cells > 300
    assert found.estimate_m < 1.03 * found.reference_m


def test_the_hall_says_that_nothing_measured_its_motion(hall: Run):
    assert all(frame.motion is None for frame in hall.slam.keyframes)
    assert all("constant velocity" in stretch.sentence for stretch in hall.slam.open_directions)
