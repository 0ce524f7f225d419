"""Real clouds without any odometry: poses found by planes alone, against what others made of the same clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.evaluation import absolute_error, compare_sharpness
from slam.geometry.frames import inverse
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


#: Of the room, not surveyed: what its odometry guessed of the second scan's place, and what ICP found, (x, y, z, yaw).
GUESS, ICP = (1.79387, 0.720047, 0.0, 0.6931), (1.964, 0.059, 0.010, np.deg2rad(40.85))


def room_with(odometry: list[tuple[float, float, float, float]] | None, folder: Path) -> Path:
    """A folder as somebody would make it who has the two scans and, or not, odometry of them."""
    for index, name in enumerate(("room_scan1.pcd", "room_scan2.pcd")):
        (folder / f"{index}.pcd").symlink_to(needs(f"pcl_room/{name}"))
    if odometry is not None:
        rows = [(k, *place, 0.0, 0.0, np.sin(yaw / 2.0), np.cos(yaw / 2.0)) for k, (*place, yaw) in enumerate(odometry)]
        (folder / "odometry.tum").write_text("\n".join(" ".join(map(str, row)) for row in rows))
    return folder


@pytest.mark.parametrize("guess", [GUESS, (2.1, 0.4, 0.0, 0.55), None], ids=["guess", "another", "none"])
def test_a_room_is_where_icp_has_it_whatever_odometry_guesses_and_its_floor_is_one_plane(guess, tmp_path: Path):
    """Two scans; not surveyed: floor -1.26 m, ceiling 1.67 m. The guess is 0.68 m off.

    Heights are less sure than places: laid by ICP's motion, the second scan's floor is 2.0 cm below the first's
    and its ceiling 0.8 cm above (medians of some 3,100 and 14,800 points that lie less than 5 cm
    from another): any height is wrong by 1.4 cm.
    """
    log, rig = load(room_with(None if guess is None else [(0.0, 0.0, 0.0, 0.0), guess], tmp_path))
    run = run_slam(log, rig, SlamConfig())
    first, second = run.trajectory.poses
    motion = inverse(first) @ second
    assert np.rad2deg(np.arctan2(motion[1, 0], motion[0, 0])) == pytest.approx(np.rad2deg(ICP[3]), abs=0.5)
    assert np.linalg.norm(motion[:2, 3] - ICP[:2]) < 0.015
    assert abs(motion[2, 3] - ICP[2]) < 0.04
    level = [one for one in run.planes if one.plane.normal[2] > 0.99 and abs(one.plane.d + 1.26) < 0.1]
    assert len(level) == 1
    assert level[0].observations == 2
