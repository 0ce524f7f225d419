"""Two clouds of a lidar that moved while it turned: found out and laid with the motion unknown; others left alone."""

from functools import lru_cache

import gtsam
import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from slam.config import SlamConfig
from slam.frontend.measurement import measured_cloud
from slam.geometry.frames import inverse
from slam.sensors.log import CloudScan
from slam.tracking.bent_pair import BentCloud, straightened

SEED = 310040


@lru_cache
def pairs(sensors: str) -> list[tuple[BentCloud, BentCloud, np.ndarray]]:
    """Neighbouring clouds of a drive round corners, with the true pose of the second in the first."""
    drive = make_drive(Recipe.parse(f"office/{sensors}/absent"), SEED)
    scans = [event for event in drive.log.events if isinstance(event, CloudScan)][:24]
    poses, sensor = drive.truth.poses_at(np.array([scan.stamp_ns for scan in scans])), drive.rig.sensors["lidar"]
    clouds = []
    for scan in scans:
        elements = measured_cloud(scan, sensor, SlamConfig()).surfaces
        assert elements is not None and scan.begin is not None
        clouds.append(BentCloud(elements, sensor, scan.begin))
    return [(clouds[k], clouds[k + 1], inverse(poses[k]) @ poses[k + 1]) for k in range(len(scans) - 1)]


def off(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    return gtsam.Pose3.Logmap(gtsam.Pose3(inverse(true) @ found))


def test_clouds_bent_in_different_ways_are_laid_to_each_other():
    """Errors are as stated but where a corner of the path begins within a turn: there the motion is not even."""
    nees, distances = [], []
    for a, b, true in pairs("turning32"):
        start = true @ gtsam.Pose3.Expmap(np.array([0.003, -0.002, 0.004, 0.01, -0.01, 0.005])).matrix()
        if (found := straightened(a, b, start)) is not None:
            error = off(found.a_T_b, true)
            nees.append(error @ np.linalg.solve(found.covariance, error) / 6.0)
            distances.append(np.linalg.norm(error[3:]))
    assert len(nees) >= 6
    assert 0.1 < np.median(nees) < 1.5 and sorted(nees)[-3] < 3.0
    assert np.median(distances) < 0.002 and max(distances) < 0.02


@pytest.mark.parametrize("which", [0, 5, 11, 17])
def test_clouds_of_one_moment_are_not_bent(which):
    a, b, true = pairs("lidar32")[which]
    assert straightened(a, b, true) is None


def test_few_elements_tell_nothing():
    a, b, true = pairs("lidar32")[0]
    few = a._replace(elements=a.elements[:5])
    assert straightened(few, b, true) is None and straightened(b, few, inverse(true)) is None
