"""Wheels that hang while a push-broom laser sees the robot drive on measure nothing, and standing robots stand."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.corpus.drives import Drive, Recipe, make_drive
from slam.config import SlamConfig
from slam.frontend.keyframes import keyframes_of
from slam.frontend.laser_odometry.stalled_wheels import stalls_of
from slam.frontend.odometry import OdometryTrack, planar_delta
from slam.geometry.frames import inverse
from slam.sensors.log import LaserScan
from slam.sensors.rig import Sensor
from tests.slam.short_drives import mapped_beginning

DRIVE = "office/pushbroom/stops/half"


@pytest.fixture(scope="module")
def hanging() -> Drive:
    """The odometry stands for a fifth of the way."""
    return make_drive(Recipe.parse(DRIVE), 771021)


def slices_of(drive: Drive) -> tuple[list[LaserScan], Sensor, OdometryTrack]:
    """The slices, the laser that saw them, and where the odometry has it: what stalls are told by."""
    [sensor] = drive.rig.of_kind("slice").values()
    scans = [scan for scan in drive.log.scans() if isinstance(scan, LaserScan)]
    return scans, sensor, OdometryTrack(drive.log.measured_motion, drive.rig.odometry)


def test_a_stretch_that_wheels_did_not_measure_is_measured_by_nobody(hanging: Drive) -> None:
    scans, sensor, track = slices_of(hanging)
    [stall] = stalls_of(scans, sensor, track)
    poses = track.poses_at([stall.first_ns, stall.last_ns])
    np.testing.assert_allclose(poses[0], poses[1], atol=2e-3)
    true = hanging.truth.poses_at([stall.first_ns, stall.last_ns])
    assert np.linalg.norm(true[1, :3, 3] - true[0, :3, 3]) > 3.0
    frames = list(keyframes_of(hanging.log, hanging.rig, SlamConfig()))
    [across] = [index for index, frame in enumerate(frames) if frame.motion and not frame.motion.is_measured]
    motion = frames[across].motion
    assert motion is not None
    before, after = hanging.truth.poses_at([frame.stamp_ns for frame in frames[across - 1 : across + 1]])
    off = planar_delta(inverse(before @ motion.a_T_b) @ after)
    assert off @ np.linalg.solve(motion.covariance, off) < 9.0
    assert stall.overlaps(frames[across - 1].stamp_ns, frames[across].stamp_ns)
    assert not any(stall.has(scan) for frame in frames for scan in frame.scans if isinstance(scan, LaserScan))
    assert any("wheels stand" in note for note in hanging.log.notes)


@pytest.mark.parametrize("name", ["hall", "sloped", "symmetric", "loop"])
def test_stretches_are_found_in_other_buildings(name: str) -> None:
    """In a hall a quarter of a slice changes: its pillars."""
    assert len(stalls_of(*slices_of(make_drive(Recipe.parse(f"{name}/pushbroom/stops"), 97101)))) == 1


@pytest.mark.parametrize("name, seed", [(DRIVE, 771021), ("glass/pushbroom/stops", 133002)])
def test_its_map_is_doubtful(name: str, seed: int) -> None:
    """Walls alike on both sides of the gap were taken for one: the second drive was 13 m off, and sound."""
    run, _ = mapped_beginning(name, seed)
    [across] = run.slam.left_open
    assert run.slam.left_open[across] > 5.0 and not run.slam.keyframes[across].motion.is_measured
    assert run.verdict.verdict == "doubtful"
    assert any("nobody measured the motion" in reason for reason in run.verdict.reasons)


@pytest.mark.parametrize("passers", [0.0, 0.3], ids=["alone", "with people about"])
def test_a_robot_that_stands_is_taken_at_its_word(hanging: Drive, passers: float) -> None:
    """The same slices with noise, before a third of whose beams somebody stands now and then."""
    scans, sensor, track = slices_of(hanging)
    rng, first = np.random.default_rng(0), scans[0]
    sigma, standing, returns = np.sqrt(sensor.range_variance_at(first.ranges)), [], np.flatnonzero(first.ranges > 0.0)
    for index in range(40):
        ranges = first.ranges + sigma * rng.standard_normal(len(sigma))
        hidden = rng.integers(0, len(returns)) + np.arange(int(passers * len(returns)))
        ranges[returns[hidden % len(returns)]] *= 0.5
        standing.append(replace(first, stamp_ns=first.stamp_ns + index, ranges=ranges))
    assert stalls_of(standing, sensor, track) == []
    moved = replace(first, stamp_ns=first.stamp_ns + 40, ranges=first.ranges + 0.5)
    assert len(stalls_of([*standing, moved], sensor, track)) == 1
