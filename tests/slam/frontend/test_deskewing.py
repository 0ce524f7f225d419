"""Scans that take time: every beam from its own place, against truth; a sweep that is not told shows."""

from dataclasses import replace

import numpy as np
import pytest

from factors.association.observations import LineObservation, PlaneObservation
from slam.config import SlamConfig
from slam.frontend.deskewing import unswept
from slam.frontend.keyframes import keyframes_of
from slam.frontend.odometry import OdometryTrack
from slam.geometry.frames import planar_transform
from slam.sensors.log import LaserScan, OdometryReading
from slam.sensors.rig import Rig, Sensor
from slam.simulation import HORIZONTAL, paper_rig, simulate_mission
from slam.simulation.mission import Mission
from tests.slam.scenes import SURE_WHEELS, with_sensors

SECOND_NS = 1_000_000_000


def with_sweep(sweep_s: float) -> Rig:
    """With sure wheels: what is left in the planes is the sweep."""
    return with_sensors(paper_rig(), sweep_s=sweep_s).model_copy(update={"odometry": SURE_WHEELS})


def turning_track() -> OdometryTrack:
    times = np.linspace(0.0, 1.0, 21)
    readings = [OdometryReading(round(t * SECOND_NS), planar_transform(0.5 * t, 0.1 * t, 0.4 * t)) for t in times]
    return OdometryTrack(readings, SURE_WHEELS)


def swept_scan() -> tuple[Sensor, LaserScan]:
    """A sensor, and exact ranges of a wall x = 4 of the odometry frame, each beam from its own pose."""
    sensor, angles = with_sweep(0.2).sensors[HORIZONTAL], np.linspace(-0.8, 0.8, 161)
    poses = turning_track().poses_at(sensor.beam_times_ns(0, len(angles)).tolist()) @ sensor.body_T_sensor
    ways = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]) + angles
    return sensor, LaserScan(0, "laser", (4.0 - poses[:, 0, 3]) / np.cos(ways), angles)


def test_a_scan_of_a_turning_robot_is_straightened():
    sensor, scan = swept_scan()
    assert np.ptp(scan.ranges * np.cos(scan.angles)) > 0.1
    straight = unswept(scan, sensor, turning_track())
    np.testing.assert_allclose(straight.ranges * np.cos(straight.angles), 4.0, atol=1e-9)
    assert unswept(scan, sensor.model_copy(update={"sweep_s": 0.0}), turning_track()) is scan


def test_a_beam_without_return_stays_one():
    sensor, scan = swept_scan()
    ranges = np.where(np.arange(161) % 7 == 0, np.nan, scan.ranges)
    straight = unswept(replace(scan, ranges=ranges), sensor, turning_track())
    np.testing.assert_array_equal(np.isnan(straight.ranges), np.isnan(ranges))
    assert (np.diff(straight.angles) >= 0.0).all()


def errors(mission: Mission, rig: Rig, kind: type) -> np.ndarray:
    """Chi2 per degree of freedom of measured planes against the nearest of the true ones, where any is near."""
    values = []
    for keyframe in keyframes_of(mission.log, rig, SlamConfig()):
        body_T_world = np.linalg.inv(mission.truth.poses_at(np.array([keyframe.stamp_ns]))[0])
        true = [plane.transform(body_T_world) for plane in mission.truth.planes]
        for seen in (one for one in keyframe.observations if isinstance(one, kind) and one.n_points > 100):
            mine = seen.full_plane(0.01)
            near = [one for one in true if one.normal @ mine.normal > 0.97 and abs(one.distance(mine.centre)) < 0.15]
            values += [min(mine.mahalanobis(one) for one in near) / 3.0] if near else []
    return np.array(values)


@pytest.fixture(scope="module")
def swept() -> Mission:
    """Three bends of a small room: driving straight, a sweep moves points along walls, where it does not show."""
    return simulate_mission("room", n_scans=140, spacing_m=0.05, seed=3, rig=with_sweep(0.09))


@pytest.mark.parametrize("kind", [PlaneObservation, LineObservation])
def test_planes_of_swept_scans_are_consistent_when_the_rig_tells_the_sweep_and_not_else(swept: Mission, kind: type):
    told, untold = (errors(swept, with_sweep(sweep), kind) for sweep in (0.09, 0.0))
    assert len(told) > 20 and 0.4 < np.median(told) < 1.3
    # of the sweeps not told, the bends show; a few lines beside a pillar may miss their wall in both
    assert np.percentile(untold, 90) > 20.0 * np.percentile(told, 90)
