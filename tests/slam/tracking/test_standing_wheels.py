"""Wheels that stand while planes say that the body turns are not believed; a body that stands does."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.corpus.drives import Recipe, make_drive
from slam.config import SlamConfig
from slam.runs.slam_run import run_slam
from slam.sensors.log import CloudScan, Log, OdometryReading
from tests.slam.short_drives import until

#: So many scans of a body that stands, half a second apart.
N_STANDING, STEP_NS = 12, 500_000_000


@pytest.mark.parametrize("kind, seed", [("lidar32", 160001), ("lidar16", 160003), ("level", 190101), ("paper", 190102)])
def test_wheels_that_hang_in_a_bare_corridor_are_found_by_its_walls(kind: str, seed: int) -> None:
    """The body wanders by a few millirad a step; along the corridor nothing tells that it drives on."""
    drive = make_drive(Recipe.parse(f"bare/{kind}/stops"), seed)
    run = run_slam(drive.log, drive.rig, SlamConfig())
    if "lidar" in kind:
        steps = np.array([np.linalg.norm(frame.motion.a_T_b[:3, 3]) for frame in run.slam.keyframes if frame.motion])
        hanging = set((1 + np.flatnonzero(steps < 1e-3)).tolist())
        against = {step.keyframe for step in run.slam.odometry_record.steps if step.check.against}
        assert len(hanging) > 5 and len(against & hanging) >= len(hanging) // 2
    assert run.verdict.verdict == "doubtful"
    assert any(one.kind == "assumption" for one in run.verdict.evidence)


@pytest.mark.parametrize("name, passers", [("bare/lidar16", 0.0), ("people/lidar32", 0.2), ("office/depth", 0.2)])
def test_a_body_that_stands_is_believed(name: str, passers: float) -> None:
    """After six scans it stands for twelve, other noise in each, and somebody before a fifth of the beams."""
    drive, rng = make_drive(Recipe.parse(name), 180005), np.random.default_rng(0)
    (sensor,) = drive.rig.sensors.values()
    at = [one for one in drive.log.scans() if isinstance(one, CloudScan)][5]
    events = until(drive.log, at.stamp_ns).events
    [*_, there] = [event for event in events if isinstance(event, OdometryReading)]
    ranges = np.linalg.norm(at.points, axis=-1, keepdims=True)
    for stamp_ns in at.stamp_ns + STEP_NS * np.arange(1, N_STANDING + 1):
        noise = np.sqrt(sensor.range_variance_at(ranges)) * rng.standard_normal(ranges.shape)
        points, columns = at.points * (1.0 + noise / ranges), at.points.shape[1]
        hidden = (int(rng.integers(columns)) + np.arange(int(passers * columns))) % columns
        points[:, hidden] *= 0.5
        events += [replace(there, stamp_ns=int(stamp_ns)), replace(at, stamp_ns=int(stamp_ns), points=points)]
    run = run_slam(Log(events, drive.log.source), drive.rig, SlamConfig())
    steps = run.slam.odometry_record.steps
    assert len(steps) == N_STANDING + 5
    assert [step.keyframe for step in steps if step.check.against] == []
