"""Logs of a real robot with one laser and raw wheel odometry, of a tilting laser, and of a camera carried by hand."""

from dataclasses import replace

import numpy as np
import pytest
import shapely

from slam import PlaneSlam, SlamConfig
from slam.evaluation import absolute_error
from slam.evaluation.trajectories import pose_errors
from slam.geometry.frames import inverse
from slam.io.clouds.depth import CAMERA_MOUNT
from slam.io.load import load
from slam.io.threedtk import read_frames
from slam.io.trajectories import Trajectory, read_tum
from slam.planeslam import MapPlane
from slam.runs.slam_run import Run, run_slam
from tests.slam.real_data import needs

#: Keyframes of loop5 before the robot first leaves the corridor it starts in, and after it has come back to it.
FIRST, LAST = 18, 100


def assert_honest(slam: PlaneSlam, least: int) -> None:
    """The audit of at least so many measurements finds their covariances right; not too small."""
    (row,) = slam.audit.summary()
    assert row.kind == "line" and row.count > least and row.verdict != "over-confident"
    assert row.mean_per_dof > 0.3  # the default rig states 15 mm, more than these lasers have


@pytest.fixture(scope="module")
def loop5() -> Run:
    """The office corridor loop."""
    return run_slam(*load(needs("loop5/loop5.clf.gz")), SlamConfig())


def test_the_corridor_loop_closes(loop5):
    """A wall of the first corridor is the same landmark at the end; with one side of it or both the map is the same."""
    known = loop5.slam.landmarks
    again = [one for one in known if one.sightings[0].keyframe < FIRST and one.sightings[-1].keyframe > LAST]
    assert again and max(abs(known.placed(one.id).normal[1]) for one in again) > 0.9


def test_odometry_alone_misses_the_start_corridor(loop5):
    """Raw odometry comes back turned by 40 deg and more; the estimate's last heading is along the first corridor."""
    turned = [np.arctan2(path.poses[-1][1, 0], path.poses[-1][0, 0]) for path in (loop5.trajectory, loop5.odometry)]
    estimate, odometry = (abs(np.rad2deg(np.remainder(angle, 2.0 * np.pi) - np.pi)) for angle in turned)
    assert estimate < 6.0  # the first corridor itself lies 3 deg off the x axis
    assert odometry > 30.0


def test_the_corridors_are_square_and_few_walls_are_double(loop5):
    """Long walls of a rectangular building differ by multiples of 90 deg."""
    known = loop5.slam.landmarks
    long = [one for one in known if one.n_keyframes >= 5 and np.ptp(shapely.get_coordinates(one.outline)[:, 0]) > 6.0]
    normals = np.array([known.placed(one.id).normal for one in long])
    angles = np.rad2deg(np.arctan2(normals[:, 1], normals[:, 0])) * 4.0
    mean = np.rad2deg(np.angle(np.exp(1j * np.deg2rad(angles)).mean()))
    spread = np.abs((angles - mean + 180.0) % 360.0 - 180.0) / 4.0
    assert len(long) >= 5 and spread.max() < 5.0 and len(known) <= 50


def test_the_audit_finds_the_covariances_honest(loop5):
    assert_honest(loop5.slam, 250)


@pytest.mark.parametrize(
    ("images", "worst_m"),
    [
        (slice(19), 0.1),
        (slice(None, None, 4), 0.05),
    ],  # 0.3 m where the floor counts by its area; turned by 20 to 40 deg
)
def test_a_camera_carried_by_hand_is_where_motion_capture_has_it(images: slice, worst_m: float):
    """Where little stands on a floor, most of an image fits wherever the camera may have gone."""
    log, rig = load(needs("tum_fr3_cabinet"))
    events = list(log.events)[images]
    run = run_slam(replace(log, events=events), rig, SlamConfig())
    truth, stamps = read_tum(needs("tum_fr3_cabinet/truth/groundtruth.txt")), run.trajectory.stamps_ns
    error = absolute_error(run.trajectory, Trajectory(stamps, truth.poses_at(stamps.tolist()) @ inverse(CAMERA_MOUNT)))
    assert len(stamps) == len(events)
    assert error.translation_m.max() < worst_m
    assert np.rad2deg(error.rotation_rad.max()) < 3.5


@pytest.fixture(scope="module")
def corridor() -> Run:
    return run_slam(*load(needs("3dtk_corridor")), SlamConfig())


#: Normals of the corridor's planes, and from where to where their distances from the first scan may be, m.
SIDES = {
    "floor": ([0.0, 0.0, 1.0], 0.2, 0.6),
    "ceiling": ([0.0, 0.0, -1.0], 1.8, 2.2),
    "right": ([0.0, 1.0, 0.0], 0.8, 1.1),
    "left": ([0.0, -1.0, 0.0], 1.2, 1.6),
}


def largest(run: Run, side: str) -> MapPlane:
    """The landmark of most points that faces as a side does (to 15 deg), at such a distance."""
    (normal, near, far), least = SIDES[side], np.cos(np.deg2rad(15.0))
    found = [one for one in run.planes if one.plane.normal @ normal > least and near < -one.plane.d < far]
    return max(found, key=lambda plane: plane.plane.n_points)


def test_floor_ceiling_and_walls_are_single_landmarks_seen_from_all_three_scans(corridor: Run):
    assert [largest(corridor, side).observations for side in SIDES] == [3] * 4


def test_height_and_width_of_the_corridor(corridor: Run):
    """The README of the data: 2.42 m and 2.39 m. Distances are sums of Hesse distances from the first scan."""
    for pair, wide_m in ((("floor", "ceiling"), 2.42), (("right", "left"), 2.39)):
        one, other = (largest(corridor, side).plane for side in pair)
        assert abs(-one.d - other.d - wide_m) < 0.02 and -(one.normal @ other.normal) > np.cos(np.deg2rad(0.5))


def test_poses_are_as_near_to_a_registration_as_two_registrations_are_to_each_other(corridor: Run):
    """To 8 %: they are 6.54 cm apart where the map is 7.02 cm from one of them."""
    folder = needs("3dtk_corridor")
    for index in (1, 2):
        better, other = (read_frames(folder / f"scan00{index}.frames.{name}") for name in ("4cc29d4c", "cf17522d"))
        off = pose_errors(inverse(better) @ np.array((other, corridor.trajectory.poses[index])))
        for limit, error in (off.translation_m, off.rotation_rad):
            assert error <= 1.08 * limit


def test_the_audit_finds_the_corridor_consistent(corridor: Run):
    assert [row.verdict for row in corridor.slam.audit.summary()] == ["consistent"]
