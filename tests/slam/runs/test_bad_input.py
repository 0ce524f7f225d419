"""Bad scans are left out and counted, bad keyframes leave no trace, silent sensors are named; strict runs end."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factors.association.observations import PlaneObservation
from slam import PlaneSlam
from slam.config import KeyframeConfig, SlamConfig
from slam.errors import LogError
from slam.frontend.input_checks import silences, skipped, without_repetitions
from slam.frontend.keyframes import Keyframe, count_keyframes, keyframes_of
from slam.frontend.measurement import planes_of_cloud
from slam.frontend.odometry import NO_FLOOR, Motion
from slam.geometry.frames import inverse, planar_transform
from slam.output.run_metrics import warnings_of
from slam.runs.slam_run import run_slam
from slam.sensors.log import CloudScan, LaserScan, Log
from slam.simulation import HORIZONTAL, SPINNING, VERTICAL, Mission, simulate_mission
from tests.slam.commands import refused
from tests.slam.scenes import drive, room_planes, run_of

STRICT = SlamConfig(keyframes=KeyframeConfig(strict=True))


@pytest.fixture(scope="module")
def hall() -> Mission:
    return simulate_mission("hall", n_scans=4, seed=0)


def with_events(mission: Mission, change) -> Log:
    events = [after for k, event in enumerate(mission.log.events) for after in change(k, event)]
    return replace(mission.log, events=events)


def without(log: Log, sensor: str, after_ns: int = -1) -> Log:
    kept = [one for one in log.events if not (getattr(one, "sensor", "") == sensor and one.stamp_ns > after_ns)]
    return replace(log, events=kept)


INDEFINITE, NOT_DEFINITE = np.diag([1e-4, 1e-4, -1e-4]), "covariance: expected a positive definite covariance, got the "
SEEN = PlaneObservation(room_planes()[0])
object.__setattr__(SEEN.plane, "covariance", INDEFINITE)  # whoever makes a plane is refused this one


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"observations": [SEEN]}, rf"keyframe.observations\[0\].plane.{NOT_DEFINITE}eigenvalue"),
        ({"covariance": INDEFINITE}, f"keyframe.motion.{NOT_DEFINITE}eigenvalue -0.0001"),
        ({"stamp_ns": 10**9}, "keyframe: expected a time after 1000000000 ns, got 1000000000 ns"),
        ({"stamp_ns": 1.5}, "keyframe.stamp_ns: expected whole nanoseconds, got 1.5"),
        ({"observations": None}, "keyframe.observations: expected a Sequence, got NoneType"),
        ({"observations": [1]}, r"keyframe.observations\[0\]: expected a plane or a line that was seen, got int"),
        ({"motion": 3}, "keyframe.motion: expected a Motion, got int"),
        ({"covariance": "wide"}, "keyframe.motion.covariance: expected FloatArray, got str"),
        ({"covariance": np.eye(2)}, r"keyframe.motion.covariance: expected shape \(3, 3\) or \(6, 6\), got \(2, 2\)"),
        ({"covariance": np.array([[1.0, 5.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])}, "not symmetric"),
    ],
)
def test_what_is_no_keyframe_is_refused_in_one_sentence_and_leaves_no_trace(change: dict[str, Any], problem: str):
    frames = drive(0, count=4).keyframes
    slam, good = run_of(frames[:2]), frames[2]
    assert good.motion is not None
    if "covariance" in change:
        change = {"motion": replace(good.motion, **change)}
    with pytest.raises(ValueError, match=problem):
        slam.add_keyframe(replace(good, **change))
    assert len(slam.trajectory) == 2
    run_of(frames[2:], slam)
    np.testing.assert_array_equal(slam.trajectory.poses, run_of(frames).trajectory.poses)


@pytest.mark.parametrize(
    ("points", "problem"),
    [
        (np.full((4, 5, 3), "a"), "points: expected an array of numbers, got <U1 array"),
        (np.zeros((4, 5, 2)), r"points: expected shape \(S, B, 3\) or \(N, 3\), got \(4, 5, 2\)"),
        (np.zeros(7), r"points: expected shape \(S, B, 3\) or \(N, 3\), got \(7,\)"),
    ],
)
def test_points_that_are_none_are_refused_in_one_sentence(hall: Mission, points: np.ndarray, problem: str):
    with pytest.raises(ValueError, match=problem):
        planes_of_cloud(CloudScan(0, SPINNING, points), hall.rig.sensors[SPINNING], SlamConfig())


def test_an_error_after_a_keyframe_has_entered_is_told_as_it_is(hall: Mission, monkeypatch: pytest.MonkeyPatch):
    """Added again it would be refused for its time, or its pose for being there, which says nothing of the cause."""

    def fails(*_: Any) -> None:
        raise ValueError("the wheels")

    monkeypatch.setattr(PlaneSlam, "_calibrate", fails)
    with pytest.raises(ValueError, match=r"^the wheels$"):
        run_slam(hall.log, hall.rig, SlamConfig())


def test_two_clouds_of_one_time_are_one_keyframe_and_end_a_strict_run(hall: Mission):
    twice = with_events(hall, lambda k, event: [event, event] if isinstance(event, CloudScan) else [event])
    frames = list(keyframes_of(twice, hall.rig, SlamConfig()))
    assert [frame.stamp_ns for frame in frames] == [scan.stamp_ns for scan in hall.log.scans()]
    assert all(len(frame.notes) == 1 and "expected a scan after" in frame.notes[0] for frame in frames)
    assert count_keyframes(twice, hall.rig, SlamConfig()) == 4
    with pytest.raises(LogError, match="expected a scan after"):
        list(keyframes_of(twice, hall.rig, STRICT))


def test_a_cloud_that_cannot_be_used_is_counted_and_ends_a_strict_run(hall: Mission):
    third = hall.log.scans()[2].stamp_ns

    def break_third(_, event):
        is_third = isinstance(event, CloudScan) and event.stamp_ns == third
        return [replace(event, points=np.zeros((5, 7, 2))) if is_third else event]

    log = with_events(hall, break_third)
    run = run_slam(log, hall.rig, SlamConfig())
    assert len(run.trajectory) == 4
    (warning,) = [one for one in warnings_of(run) if "could not be used" in one]
    assert warning.startswith("1 scan could not be used: at") and skipped([]) == []
    assert skipped(["at 1.0 s: a", "at 2.0 s: b"]) == ["2 scans could not be used; the first: at 1.0 s: a"]
    with pytest.raises(ValueError):
        run_slam(log, hall.rig, STRICT)


def test_scans_without_planes_only_move(hall: Mission):
    def blind(_, event):
        return [replace(event, points=np.full_like(event.points, np.nan))] if isinstance(event, CloudScan) else [event]

    run = run_slam(with_events(hall, blind), hall.rig, SlamConfig())
    assert len(run.trajectory) == 4 and run.planes == []
    assert any("information only from odometry at 3 of 3 keyframes" in one for one in warnings_of(run))


def test_a_silent_sensor_is_named():
    room = simulate_mission("room", n_scans=120, seed=0)
    assert silences(room.log, room.rig) == []
    never = without(room.log, VERTICAL)
    assert silences(never, room.rig) == [f"sensor '{VERTICAL}' is silent: no scan of it in the log"]
    stamps = [scan.stamp_ns for scan in room.log.scans(HORIZONTAL)]
    (sentence,) = silences(without(room.log, HORIZONTAL, after_ns=stamps[3]), room.rig)
    assert sentence.startswith(f"sensor '{HORIZONTAL}' is silent for") and "to the end" in sentence
    run = run_slam(never, room.rig, SlamConfig())
    assert len(run.trajectory) > 2 and any("is silent" in one for one in warnings_of(run))
    assert all(isinstance(scan, LaserScan) for scan in never.scans())


def test_a_batch_is_the_same_graph_and_the_run_can_go_on(hall: Mission):
    steps, whole = (run_slam(hall.log, hall.rig, SlamConfig(), batch=batch) for batch in (False, True))
    np.testing.assert_allclose(whole.trajectory.poses, steps.trajectory.poses, atol=2e-3)
    assert [one.id for one in whole.planes] == [one.id for one in steps.planes]
    assert SPINNING in {scan.sensor for scan in hall.log.scans()}
    assert whole.slam.backend.chi2() <= steps.slam.backend.chi2() + 1e-6
    landmark = next(one for one in whole.slam.landmarks if one.n_keyframes == 4)
    factors, last = whole.slam.backend.graph, whole.slam.keyframes[-1]
    assert all(landmark.key in list(factors.at(one.factor_index).keys()) for one in landmark.sightings)
    whole.slam.add_keyframe(Keyframe(last.stamp_ns + 1, last.observations, last.motion))


def test_nothing_in_a_name_steers_the_terminal(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A log whose name and records bring escape sequences and rich's own markup: they are shown, not done."""
    evil = tmp_path / "a\x1b[2J\x1b]0;owned\x07[red]\u202egol.clf"
    evil.write_text("FLASER 3 1 2 3 0 0 0 0 0 0 1 host 1\nX\x1b[31mODOM 1\n")
    said = refused(capsys, "slam", evil, "--out", tmp_path / "out")
    assert not any(character in said for character in "\x1b\x07\u202e") and "\\x1b[2J" in said and "[red]" in said


def test_a_3d_sensor_that_hangs_while_wheels_move_tells_nothing() -> None:
    """Scan 1 again and again; the wheels go on at 3 cm a step. Standing, a simulation without noise repeats itself."""
    rng = np.random.default_rng(0)
    first, second, third = rng.normal(0.0, 1.0, (3, 5, 9))

    def frame(stamp_ns: int, surfaces: np.ndarray | None, ahead_m: float = 0.0) -> Keyframe:
        step = Motion(planar_transform(ahead_m, 0.0, 0.0), np.eye(3), NO_FLOOR)
        return Keyframe(stamp_ns, [], step, surfaces=surfaces)

    ways = [(first, 0.0), (first, 0.0), (second, 0.03), (second, 0.03), (None, 0.0), (second, 0.03), (third, 0.03)]
    frames = [frame(k, None if one is None else one.copy(), ahead_m) for k, (one, ahead_m) in enumerate(ways)]
    found = list(without_repetitions(frames))
    assert [one.surfaces is None for one in found] == [False, False, False, False, True, True, False]
    assert [len(one.notes) for one in found] == [0, 0, 0, 0, 0, 1, 0]
    assert "to the last bit" in found[5].notes[0] and found[5].observations == []
    assert not any(one.notes for one in without_repetitions([replace(one, motion=None) for one in frames]))


def test_while_a_lidar_hangs_the_wheels_say_where_it_is() -> None:
    made = simulate_mission("hall", n_scans=6, seed=0)
    clouds = [k for k, event in enumerate(made.log.events) if isinstance(event, CloudScan)]
    hangs = dict.fromkeys(clouds[3:5], made.log.events[clouds[2]].points)
    events = [replace(one, points=hangs[k]) if k in hangs else one for k, one in enumerate(made.log.events)]
    run = run_slam(replace(made.log, events=events), made.rig, SlamConfig())
    truth = made.truth.poses_at(run.trajectory.stamps_ns)
    off = [
        (inverse(truth[0]) @ t - inverse(run.trajectory.poses[0]) @ p)[:3, 3]
        for t, p in zip(truth, run.trajectory.poses, strict=True)
    ]
    assert np.linalg.norm(off, axis=1).max() < 0.15
    assert any("2 scans could not be used" in warning for warning in warnings_of(run))
