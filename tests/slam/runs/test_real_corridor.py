"""The main job on real input: three tilting-laser scans of a corridor (3DTK)."""

import numpy as np
import pytest

from slam.config import SlamConfig
from slam.io.load import load
from slam.io.threedtk import read_frames
from slam.planeslam import MapPlane
from slam.runs.slam_run import Run, run_slam
from tests.slam.real_data import needs


@pytest.fixture(scope="module")
def run() -> Run:
    return run_slam(*load(needs("3dtk_corridor")), SlamConfig())


def largest(run: Run, normal: list[float], near_d: tuple[float, float]) -> MapPlane:
    """The landmark of most points that faces along `normal` (to 15 deg) at such a distance from the first scan."""
    found = [
        plane
        for plane in run.planes
        if plane.plane.normal @ np.array(normal) > np.cos(np.deg2rad(15.0)) and near_d[0] < -plane.plane.d < near_d[1]
    ]
    assert found, f"no plane that faces {normal}"
    return max(found, key=lambda plane: plane.plane.n_points)


def angle_deg(first: MapPlane, second: MapPlane) -> float:
    return float(np.rad2deg(np.arccos(min(1.0, abs(float(first.plane.normal @ second.plane.normal))))))


def test_floor_ceiling_and_walls_are_single_landmarks_seen_from_all_three_scans(run: Run):
    for normal, near_d in (
        ([0.0, 0.0, 1.0], (0.2, 0.6)),
        ([0.0, 0.0, -1.0], (1.8, 2.2)),
        ([0.0, 1.0, 0.0], (0.8, 1.1)),
        ([0.0, -1.0, 0.0], (1.2, 1.6)),
    ):
        assert largest(run, normal, near_d).observations == 3


def test_height_and_width_of_the_corridor(run: Run):
    """The README of the data: 2.42 m and 2.39 m. Distances are sums of Hesse distances from the first scan."""
    floor, ceiling = largest(run, [0.0, 0.0, 1.0], (0.2, 0.6)), largest(run, [0.0, 0.0, -1.0], (1.8, 2.2))
    right, left = largest(run, [0.0, 1.0, 0.0], (0.8, 1.1)), largest(run, [0.0, -1.0, 0.0], (1.2, 1.6))
    assert abs(-floor.plane.d - ceiling.plane.d - 2.42) < 0.02 and angle_deg(floor, ceiling) < 0.5
    assert abs(-right.plane.d - left.plane.d - 2.39) < 0.02 and angle_deg(right, left) < 0.5


def test_poses_are_as_near_to_a_registration_as_two_registrations_are_to_each_other(run: Run):
    """To 5 %: they are 6.54 cm apart where the map is 6.57 cm from one of them."""
    folder = needs("3dtk_corridor")
    for index in (1, 2):
        better = read_frames(folder / f"scan00{index}.frames.4cc29d4c")
        other = read_frames(folder / f"scan00{index}.frames.cf17522d")
        for limit, error in zip(distance(better, other), distance(better, run.trajectory.poses[index]), strict=True):
            assert error <= 1.05 * limit


def test_the_audit_finds_the_run_consistent(run: Run):
    assert [row.verdict for row in run.slam.audit.summary()] == ["consistent"]


def distance(first: np.ndarray, second: np.ndarray) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    turn = first[:3, :3].T @ second[:3, :3]
    angle = np.rad2deg(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0), -1.0, 1.0)))
    return float(np.linalg.norm(first[:3, 3] - second[:3, 3])), float(angle)
