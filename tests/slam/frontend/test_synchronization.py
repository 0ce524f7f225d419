"""Temporal calibration: offsets between scans and odometry are found, and none where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.corpus.floorplan import Drive
from slam import PlaneSlam
from slam.config import SlamConfig
from slam.frontend.keyframes import keyframes_of
from slam.frontend.laser_odometry.synchronization import ClockOffset, clock_offset
from slam.frontend.laser_odometry.tracker import _surface
from slam.frontend.odometry import OdometryTrack
from slam.io.trajectories import Trajectory
from slam.output.run_metrics import warnings_of
from slam.runs.slam_run import Run, StageClock
from slam.sensors.log import LaserScan, Log, OdometryReading
from tests.slam.frontend.test_laser_odometry import rooms, stated

OFTEN_NS = 50_000_000


def read_often(truth: Drive, late_s: float) -> Log:
    """The drive with odometry read twenty times a second beside the scans, stamped late."""
    scans = [event for event in truth.log.events if isinstance(event, LaserScan)]
    wheels = OdometryTrack(truth.log.odometry, stated(truth.log).odometry)
    times = np.arange(scans[0].stamp_ns, scans[-1].stamp_ns + 1, OFTEN_NS).tolist()
    late_ns = round(late_s * 1e9)
    readings = [OdometryReading(t + late_ns, pose) for t, pose in zip(times, wheels.poses_at(times), strict=True)]
    return in_order(truth.log, scans, readings)


def in_order(log: Log, scans: list[LaserScan], readings: list[OdometryReading]) -> Log:
    events = sorted([*readings, *scans], key=lambda one: (one.stamp_ns, isinstance(one, LaserScan)))
    return replace(log, events=list(events))


def told_by(log: Log) -> ClockOffset | None:
    rig = stated(log)
    scans = [event for event in log.events if isinstance(event, LaserScan)]
    return clock_offset(log.odometry, scans, lambda scan: _surface(scan, rig.sensors[scan.sensor]), rig.odometry)


@pytest.mark.parametrize("late_s", [0.12, -0.2])
def test_odometry_stamped_at_another_time_is_found_and_said(late_s: float):
    found = told_by(read_often(rooms(3), late_s))
    assert found is not None and found.stale == 0
    assert found.offset_s == pytest.approx(-late_s, abs=0.03)  # where odometry is late, scans are early
    assert ("earlier" if late_s > 0.0 else "later") in found.sentence
    assert f"{abs(found.offset_s):.2f} s" in found.sentence


@pytest.mark.parametrize("seed", range(4))
def test_of_clocks_that_agree_nothing_is_said(seed: int):
    assert told_by(read_often(rooms(seed), 0.0)) is None
    assert told_by(rooms(seed).log) is None  # read at the scans alone


def test_stale_copies_beside_the_scans_are_told_from_the_readings_between():
    truth = rooms(5)
    between = read_often(truth, 0.0)
    scans = [event for event in between.events if isinstance(event, LaserScan)]
    stamped = {scan.stamp_ns for scan in scans}
    readings = [one for one in between.odometry if one.stamp_ns not in stamped]
    rng, wheels = np.random.default_rng(5), OdometryTrack(readings, stated(between).odometry)
    ages = rng.integers(0, 400_000_000, len(scans))
    stale = wheels.poses_at([scan.stamp_ns - int(age) for scan, age in zip(scans, ages, strict=True)])
    copies = [OdometryReading(scan.stamp_ns, pose) for scan, pose in zip(scans, stale, strict=True)]
    found = told_by(in_order(between, scans, [*readings, *copies]))
    assert found is not None and found.stale == len(copies)
    assert found.offset_s == pytest.approx(0.0, abs=0.02)
    assert f"{len(copies)} readings" in found.sentence


def test_a_drive_without_turns_tells_nothing_of_the_time():
    log = read_often(rooms(3), 0.12)
    scans = [event for event in log.events if isinstance(event, LaserScan)][:8]
    assert told_by(in_order(log, scans, log.odometry)) is None
    assert told_by(replace(log, events=list(scans))) is None


def test_a_run_says_so():
    log = read_often(rooms(4), 0.15)
    frames = [*zip(range(2), keyframes_of(log, stated(log), SlamConfig()), strict=False)]
    assert "earlier than the odometry" in " ".join(note for _, frame in frames for note in frame.motion_notes)
    slam = PlaneSlam()
    for _, frame in frames:
        slam.add_keyframe(frame)
    run = Run(slam, slam.planes, slam.trajectory, Trajectory.empty(), log, stated(log), StageClock())
    said = warnings_of(run)
    assert sum("earlier than the odometry" in one for one in said) == 1
    assert not any("could not be used" in one for one in said)
