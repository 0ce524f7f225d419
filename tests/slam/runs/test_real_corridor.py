"""The main job on real input: three tilting-laser scans of a corridor (3DTK)."""

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.evaluation.trajectories import pose_errors
from slam.geometry.frames import inverse
from slam.io.load import load
from slam.io.threedtk import read_frames
from slam.planeslam import MapPlane
from slam.runs.slam_run import Run, run_slam
from tests.slam.real_data import needs


@pytest.fixture(scope="module")
def run() -> Run:
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


def test_floor_ceiling_and_walls_are_single_landmarks_seen_from_all_three_scans(run: Run):
    assert [largest(run, side).observations for side in SIDES] == [3] * 4


def test_height_and_width_of_the_corridor(run: Run):
    """The README of the data: 2.42 m and 2.39 m. Distances are sums of Hesse distances from the first scan."""
    for pair, wide_m in ((("floor", "ceiling"), 2.42), (("right", "left"), 2.39)):
        one, other = (largest(run, side).plane for side in pair)
        assert abs(-one.d - other.d - wide_m) < 0.02 and -(one.normal @ other.normal) > np.cos(np.deg2rad(0.5))


def test_poses_are_as_near_to_a_registration_as_two_registrations_are_to_each_other(run: Run):
    """To 5 %: they are 6.54 cm apart where the map is 6.57 cm from one of them."""
    folder = needs("3dtk_corridor")
    for index in (1, 2):
        better, other = (read_frames(folder / f"scan00{index}.frames.{name}") for name in ("4cc29d4c", "cf17522d"))
        off = pose_errors(inverse(better) @ np.array((other, run.trajectory.poses[index])))
        for limit, error in (off.translation_m, off.rotation_rad):
            assert error <= 1.05 * limit


def test_the_audit_finds_the_run_consistent(run: Run):
    assert [row.verdict for row in run.slam.audit.summary()] == ["consistent"]
