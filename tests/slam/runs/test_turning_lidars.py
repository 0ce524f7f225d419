"""Logs of a lidar that turned while it moved: found out, mapped as seen in time, recorded; others stay as they are."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.corpus.drives import Drive, Recipe, make_drive
from benchmarks.corpus.score import score
from slam.config import SlamConfig
from slam.diagnostics.evidence.mounts import turn_evidence
from slam.frontend.odometry import OdometryTrack
from slam.planeslam import PlaneSlam
from slam.runs.slam_run import Run, run_slam
from slam.sensors.log import CloudScan, Log
from slam.session.store import Session
from slam.tracking.turns import Turn, TurnSearch, sweeps_along


def drive(name: str, clouds: int, seed: int = 310002) -> Drive:
    """The first clouds of a drive."""
    whole = make_drive(Recipe.parse(name), seed)
    last = [event.stamp_ns for event in whole.log.events if isinstance(event, CloudScan)][clouds - 1]
    events = [event for event in whole.log.events if event.stamp_ns <= last]
    labels = {sensor: rows[:clouds] for sensor, rows in whole.truth.labels.items()}
    return replace(whole, log=Log(events, whole.log.source), truth=replace(whole.truth, labels=labels))


def mapped(given: Drive, **how) -> Run:
    return run_slam(Log(given.log.events, given.log.source), given.rig, SlamConfig(), **how)


@pytest.fixture(scope="module")
def by_wheels() -> tuple[Drive, Run]:
    given = drive("irregular/turning16/good", 36)
    return given, mapped(given)


def test_a_turn_is_found_and_taken_apart(by_wheels):
    given, run = by_wheels
    row = score(run, given)
    assert run.rig.sensors["lidar"].sweep_s == 0.1
    assert any("turns of 0.1 s" in note for note in run.log.notes)
    assert row["rmse, m"] < 0.005 and row["plane NEES/dof"] < 2.5
    assert run.verdict.verdict == "sound"


def test_what_is_stated_is_what_is_found(by_wheels):
    given, run = by_wheels
    sensor = given.rig.sensors["lidar"].model_copy(update={"sweep_s": 0.1})
    told = replace(given, rig=given.rig.model_copy(update={"sensors": {"lidar": sensor}}))
    again = mapped(told)
    assert not any("turns of" in note for note in again.log.notes)
    np.testing.assert_array_equal(again.trajectory.poses, run.trajectory.poses)


def test_without_wheels_the_map_tells_how_the_body_moved():
    given = drive("irregular/turning16/absent", 44)
    run = mapped(given)
    row = score(run, given)
    assert run.rig.sensors["lidar"].sweep_s == 0.1
    assert row["rmse, m"] < 0.006 and row["worst, m"] < max(0.02, 4.0 * row["sigma, m"])
    sensor = given.rig.sensors["lidar"].model_copy(update={"sweep_s": 0.1})
    stated = mapped(replace(given, rig=given.rig.model_copy(update={"sensors": {"lidar": sensor}})))
    np.testing.assert_array_equal(stated.trajectory.poses, run.trajectory.poses)


def test_clouds_of_one_moment_stay_as_they_are():
    run = mapped(drive("irregular/lidar16/good", 20))
    assert run.rig.sensors["lidar"].sweep_s == 0.0 and not run.log.notes
    assert not list(turn_evidence(run.slam.keyframes, run.trajectory, run.rig))


def test_how_long_a_turn_takes_is_shown(by_wheels):
    given, run = by_wheels
    clouds = {event.stamp_ns: event for event in given.log.events if isinstance(event, CloudScan)}
    along = replace(run.trajectory, poses=given.truth.poses_at(run.trajectory.stamps_ns))
    track = OdometryTrack(given.log.odometry, given.rig.odometry)
    search = TurnSearch(given.rig.sensors["lidar"], run.slam.keyframes, track, clouds)
    found = search.turn(along, track)
    assert found is not None and found.start == 0.0
    assert found.seconds == pytest.approx(0.1, rel=0.12)
    assert abs(search.left(Turn(0.1), run.slam.keyframes, along, track)) < 0.002


def test_points_in_no_order_show_where_the_turn_begins(by_wheels):
    given, run = by_wheels
    rng, sensor = np.random.default_rng(5), given.rig.sensors["lidar"]
    clouds = {
        event.stamp_ns: replace(event, points=rng.permutation(event.points.reshape(-1, 3)))
        for event in given.log.events
        if isinstance(event, CloudScan)
    }
    true = given.truth.poses_at(run.trajectory.stamps_ns)
    along = replace(run.trajectory, poses=true)
    search = TurnSearch(sensor, run.slam.keyframes, sweeps_along(along).track, clouds)
    found = search.turn(along, sweeps_along(along).track)
    assert found is not None and found.usual().seconds == 0.1
    assert min(found.start, 1.0 - found.start) < 0.03
    none = search.agreement(Turn(), along, sweeps_along(along).track)
    assert search.agreement(found.usual(), along, sweeps_along(along).track) > none


def test_a_session_is_of_the_run_that_is_kept(by_wheels, tmp_path):
    given, run = by_wheels
    path = tmp_path / "session.db"
    Session.make(path, SlamConfig(), rig=given.rig)
    with PlaneSlam.open(path) as slam:
        kept = mapped(given, slam=slam).trajectory.poses
    np.testing.assert_array_equal(kept, run.trajectory.poses)
    with PlaneSlam.open(path, read_only=True) as again:
        np.testing.assert_array_equal(again.trajectory.poses, kept)
    with Session.open(path, read_only=True) as session:
        assert session.rig is not None and session.rig.sensors["lidar"].sweep_s == 0.1
        assert len(session) == len(kept) and all(session.scans(index) for index in range(len(session)))


def test_a_run_that_died_when_it_was_mapped_again_is_what_it_was(tmp_path):
    given = drive("irregular/turning16/absent", 44)
    path = tmp_path / "session.db"
    Session.make(path, SlamConfig(), rig=given.rig)
    with PlaneSlam.open(path) as slam:
        kept = mapped(given, slam=slam).trajectory.poses
    with Session.open(path, read_only=True) as session:
        rig = session.rig
    assert rig is not None and rig.sensors["lidar"].sweep_s == 0.1
    with PlaneSlam.open(path) as slam:  # its results were never written
        again = mapped(replace(given, rig=rig), slam=slam)
    np.testing.assert_array_equal(again.trajectory.poses, kept)


def test_who_keeps_nothing_in_memory_is_told(by_wheels, tmp_path):
    given, _ = by_wheels
    with PlaneSlam.open(tmp_path / "session.db", forget_raw=True) as slam:
        run = mapped(given, slam=slam)
        assert run.rig.sensors["lidar"].sweep_s == 0.0
        assert any("state sweep_s" in reason for reason in run.verdict.reasons)
