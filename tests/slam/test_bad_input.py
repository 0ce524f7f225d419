"""Bad scans are left out and counted, bad keyframes leave no trace, silent sensors are named; strict runs end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam import PlaneSlam
from slam.config import KeyframeConfig, SlamConfig
from slam.health import silences
from slam.io.log import CloudScan, LaserScan, Log, LogError
from slam.keyframes import Keyframe, count_keyframes, keyframes_of
from slam.metrics import warnings_of
from slam.observations import PlaneObservation
from slam.run import run_slam
from slam.simulation import HORIZONTAL, SPINNING, VERTICAL, Mission, simulate_mission
from tests.slam.scenes import drive

STRICT = SlamConfig(keyframes=KeyframeConfig(strict=True))


@pytest.fixture(scope="module")
def hall() -> Mission:
    return simulate_mission("hall", n_scans=4, seed=0)


@pytest.fixture(scope="module")
def room() -> Mission:
    return simulate_mission("room", n_scans=120, seed=0)


def with_events(mission: Mission, change) -> Log:
    """The mission's log with its 3D scans (or all events) changed: a list of events for each."""
    events = [after for k, event in enumerate(mission.log.events) for after in change(k, event)]
    return replace(mission.log, events=events)


def without(log: Log, sensor: str, after_ns: int = -1) -> Log:
    kept = [one for one in log.events if not (getattr(one, "sensor", "") == sensor and one.stamp_ns > after_ns)]
    return replace(log, events=kept)


@pytest.mark.parametrize("part", ["plane", "motion"])
def test_a_covariance_that_is_none_is_refused_and_leaves_no_trace(part: str):
    scene = drive(0, count=4)
    slam = PlaneSlam()
    for frame in scene.keyframes[:2]:
        slam.add_keyframe(frame)
    good = scene.keyframes[2]
    wrong = np.diag([1e-4, 1e-4, -1e-4])
    if part == "plane":
        first = good.observations[0]
        assert isinstance(first, PlaneObservation)
        seen = PlaneObservation(replace(first.plane, covariance=np.diag([1e-4, 1e-4, 1e-4])))
        seen.plane.covariance[:] = wrong
        bad = replace(good, observations=[seen, *good.observations[1:]])
        problem = r"keyframe.observations\[0\].plane.covariance: expected a positive definite covariance, got the eigen"
    else:
        assert good.motion is not None
        bad = replace(good, motion=replace(good.motion, covariance=wrong))
        problem = "keyframe.motion.covariance: expected a positive definite covariance, got the eigenvalue -0.0001"
    with pytest.raises(ValueError, match=problem):
        slam.add_keyframe(bad)
    assert len(slam.trajectory) == 2
    for frame in scene.keyframes[2:]:
        slam.add_keyframe(frame)
    clean = PlaneSlam()
    for frame in scene.keyframes:
        clean.add_keyframe(frame)
    np.testing.assert_array_equal(slam.trajectory.poses, clean.trajectory.poses)


def test_a_nan_in_the_motion_is_refused():
    frame = drive(0, count=2).keyframes[1]
    assert frame.motion is not None
    moved = frame.motion.a_T_b.copy()
    moved[0, 3] = np.nan
    slam = PlaneSlam()
    slam.add_keyframe(drive(0, count=2).keyframes[0])
    with pytest.raises(ValueError, match=r"keyframe\.motion\.a_T_b: expected finite numbers, got nan"):
        slam.add_keyframe(replace(frame, motion=replace(frame.motion, a_T_b=moved)))


def test_two_clouds_of_one_time_are_one_keyframe_and_end_a_strict_run(hall: Mission):
    twice = with_events(hall, lambda k, event: [event, event] if isinstance(event, CloudScan) else [event])
    frames = list(keyframes_of(twice, hall.rig, SlamConfig()))
    assert [frame.stamp_ns for frame in frames] == [scan.stamp_ns for scan in hall.log.scans()]
    assert count_keyframes(twice, hall.rig, SlamConfig()) == 4
    with pytest.raises(LogError, match="expected a scan after"):
        list(keyframes_of(twice, hall.rig, STRICT))


def test_a_cloud_that_cannot_be_used_is_counted_and_ends_a_strict_run(hall: Mission):
    third = hall.log.scans()[2].stamp_ns

    def break_third(_, event):
        if isinstance(event, CloudScan) and event.stamp_ns == third:
            return [replace(event, points=np.zeros((5, 7, 2)))]
        return [event]

    log = with_events(hall, break_third)
    run = run_slam(log, hall.rig, SlamConfig())
    assert len(run.trajectory) == 4
    (warning,) = [one for one in warnings_of(run) if "could not be used" in one]
    assert warning.startswith("1 scans could not be used; the first: at")
    with pytest.raises(ValueError):
        run_slam(log, hall.rig, STRICT)


def test_scans_without_planes_only_move(hall: Mission):
    def blind(_, event):
        return [replace(event, points=np.full_like(event.points, np.nan))] if isinstance(event, CloudScan) else [event]

    run = run_slam(with_events(hall, blind), hall.rig, SlamConfig())
    assert len(run.trajectory) == 4 and run.planes == []
    assert any("information only from odometry at 3 of 3 keyframes" in one for one in warnings_of(run))


def test_a_silent_sensor_is_named(room: Mission):
    assert silences(room.log, room.rig) == []
    never = without(room.log, VERTICAL)
    assert silences(never, room.rig) == [f"sensor '{VERTICAL}' is silent: no scan of it in the log"]
    stamps = [scan.stamp_ns for scan in room.log.scans(HORIZONTAL)]
    early = without(room.log, HORIZONTAL, after_ns=stamps[3])
    (sentence,) = silences(early, room.rig)
    assert sentence.startswith(f"sensor '{HORIZONTAL}' is silent for") and "to the end" in sentence
    run = run_slam(never, room.rig, SlamConfig())
    assert len(run.trajectory) > 2
    assert any("is silent" in one for one in warnings_of(run))
    assert all(isinstance(scan, LaserScan) for scan in never.scans())


def test_a_batch_is_the_same_graph_and_the_run_can_go_on(hall: Mission):
    steps, whole = (run_slam(hall.log, hall.rig, SlamConfig(), batch=batch) for batch in (False, True))
    np.testing.assert_allclose(whole.trajectory.poses, steps.trajectory.poses, atol=2e-3)
    assert [one.id for one in whole.planes] == [one.id for one in steps.planes]
    assert SPINNING in {scan.sensor for scan in hall.log.scans()}
    chi2 = whole.slam.backend.chi2()
    assert chi2 <= steps.slam.backend.chi2() + 1e-6
    landmark = next(one for one in whole.slam.landmarks if one.n_keyframes == 4)
    factors = whole.slam.backend.graph
    assert all(landmark.key in list(factors.at(one.factor_index).keys()) for one in landmark.sightings)
    last = whole.slam.keyframes[-1]
    whole.slam.add_keyframe(Keyframe(last.stamp_ns + 1, last.observations, last.motion))
