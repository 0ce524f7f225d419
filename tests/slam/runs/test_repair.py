"""A run that is wrong says so, is mapped again with what the whole drive agrees on, and is right then."""

import sqlite3
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.corpus import drives as corpus
from slam import PlaneSlam
from slam.config import LoopConfig, SlamConfig
from slam.frontend.keyframes import Keyframe, keyframes_of
from slam.frontend.odometry import planar_delta
from slam.frontend.pose_measurements import PlaceMatch
from slam.geometry.frames import inverse, planar_transform
from slam.io.default_rigs import default_rig_for
from slam.output.run_metrics import details_of, metrics_of
from slam.runs.repair import is_open_to_repair, repaired
from slam.runs.slam_run import Run, odometry_of, run_slam
from slam.session._codec import encode
from slam.session.replay import Places, SessionRecorder
from slam.session.store import Session, SessionDamaged, salvage_session
from slam.simulation import simulate_mission
from tests.slam.commands import run as run_command
from tests.slam.diagnostics.evidence.test_look import turned
from tests.slam.laser_floors import Drive, Wheels, drive, ring
from tests.slam.scenes import run_of

#: The keyframe that somebody says stands elsewhere, from an early one, by so much, and how sure: the map has to bend.
AT, OLD, ASIDE, SURE = 80, 4, (1.2, 0.4, 0.03), (1e-4, 1e-4, 1e-5)


@pytest.fixture(scope="module")
def truth() -> Drive:
    rng = np.random.default_rng(4)
    plan = ring(rng, length_m=10.0, depth_m=7.0, doors_per_wall=3)
    return drive(plan, rng, wheels=Wheels(scale=0.04, curvature_rad_per_m=0.05))


@pytest.fixture(scope="module")
def frames(truth: Drive) -> list[Keyframe]:
    """The keyframes of a drive round a block, one with a loop that is none."""
    made = list(keyframes_of(truth.log, default_rig_for(truth.log), SlamConfig()))
    old, at = (truth.poses_at(np.array([made[index].stamp_ns]))[0] for index in (OLD, AT))
    false = planar_delta(inverse(old) @ at @ planar_transform(*ASIDE))
    made[AT] = replace(made[AT], places=(PlaceMatch(OLD, false, np.diag(SURE) ** 2),))
    return made


@pytest.fixture(scope="module")
def bent(frames: list[Keyframe], truth: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session of the run that believed it."""
    path = tmp_path_factory.mktemp("bent") / "session.db"
    with PlaneSlam.open(path, SlamConfig()) as slam:
        run_of(frames, slam)
    return path


@pytest.fixture(scope="module")
def mended(bent: Path, truth: Drive, tmp_path_factory: pytest.TempPathFactory):
    """A copy of it mended: the run, its session, the error before, the progress told, and the session until then."""
    path, told = tmp_path_factory.mktemp("mended") / "session.db", []
    until_then, count = path.with_name("until_then.db"), PlaneSlam.supersede

    def kept(slam: PlaneSlam, first: PlaneSlam, places: Places) -> None:
        with sqlite3.connect(path) as now, sqlite3.connect(until_then) as copy:
            now.backup(copy)
        count(slam, first, places)

    path.write_bytes(bent.read_bytes())
    with PlaneSlam.open(path) as slam, pytest.MonkeyPatch.context() as patch:
        patch.setattr(PlaneSlam, "supersede", kept)
        before = errors(slam, truth).max()
        out = repaired(slam, default_rig_for(truth.log), lambda done, total: told.append((done, total)))
    return out, path, before, told, until_then


def errors(slam: PlaneSlam, truth: Drive) -> np.ndarray:
    """Of the poses, the first given, m."""
    path = slam.trajectory
    away = inverse(path.poses[0]) @ path.poses - truth.poses_at(path.stamps_ns)
    return np.linalg.norm(away[:, :2, 3], axis=1)


def test_a_false_loop_is_found_and_the_drive_mapped_without_it(mended, truth: Drive):
    out, _, before, told, _ = mended
    [repair] = out.repairs
    assert before > 0.5 and errors(out.slam, truth).max() < 0.05 and out.verdict.verdict == "sound"
    assert repair.before.startswith("the map is broken") and repair.moved >= 1 and repair.offset_m > 0.1
    assert f"{repair.moved} of {repair.places} places" in repair.sentence
    assert told[-1] == (len(out.slam.keyframes), len(out.slam.keyframes))


def test_the_mended_run_is_what_its_session_is_replayed_to_and_goes_on_as_any(mended, frames, tmp_path: Path):
    copy = tmp_path / "session.db"
    copy.write_bytes(mended[1].read_bytes())
    with PlaneSlam.open(copy) as slam:
        assert slam.trajectory.poses.tobytes() == mended[0].slam.trajectory.poses.tobytes()
        last = frames[-1]
        slam.add_keyframe(replace(last, stamp_ns=last.stamp_ns + 10**9))
        whole = slam.trajectory.poses
    with PlaneSlam.open(copy, read_only=True, forget_raw=True) as again:
        assert again.trajectory.poses.tobytes() == whole.tobytes()
        assert all(match.delta[0] < 1.0 for match in again.keyframes[AT].places if match.keyframe == OLD)


def test_until_the_new_map_counts_the_session_is_the_old_one(mended, bent: Path):
    *_, until_then = mended
    with Session.open(until_then, read_only=True) as session, Session.open(bent, read_only=True) as before:
        assert session.places == {} and len(session) == len(before)
        assert all(encode(session.decisions(k)) == encode(before.decisions(k)) for k in range(len(before)))


def damaged(path: Path, copy: Path, table: str, row: str) -> Path:
    """A copy of a session of which a row of a table has a byte too many."""
    copy.write_bytes(path.read_bytes())
    with sqlite3.connect(copy) as other:
        other.execute(f"UPDATE {table} SET data = CAST(data || X'00' AS BLOB) WHERE {row}")
    return copy


@pytest.mark.parametrize(("found", "key", "kept"), [("mended", "places", 80), ("misplaced", "start", 20)])
def test_what_was_found_is_told_from_what_is_damaged_and_salvaged(found, key, kept, request, tmp_path: Path):
    path = request.getfixturevalue(found)[1]
    with pytest.raises(SessionDamaged, match=key):
        Session.open(damaged(path, tmp_path / "damaged.db", "session", f"key = '{key}'"), read_only=True)
    saved = damaged(path, tmp_path / "saved.db", "keyframes", f"id = {kept}")
    assert f"saved {kept} keyframes" in salvage_session(saved)
    with Session.open(saved, read_only=True) as again, Session.open(path, read_only=True) as whole:
        assert len(again) == kept and encode(again.start) == encode(whole.start)
        for index in range(kept):
            assert encode(list(again.keyframe(index).places)) == encode(list(whole.keyframe(index).places))
            assert encode(again.decisions(index)) == encode(whole.decisions(index))


def test_numbers_and_table_tell_what_was_repaired(mended, truth: Drive):
    out = mended[0]
    rig, path = default_rig_for(truth.log), out.slam.trajectory
    run = Run(out.slam, out.slam.planes, path, odometry_of(truth.log, rig, path), truth.log, rig, out.slam.clock,
              out.repairs, out.verdict)  # fmt: skip
    assert {"places laid anew", "  the farthest by"} <= {row.name for row in metrics_of(run)}
    assert details_of(run)["repairs"][0]["before"].startswith("the map is broken")


@pytest.mark.parametrize(("loops", "keeps"), [(LoopConfig(), True), (LoopConfig(max_candidates=0), False)])
def test_where_no_loops_are_looked_for_none_are_mended(loops: LoopConfig, keeps: bool):
    assert is_open_to_repair(PlaneSlam(SlamConfig(loops=loops))) is keeps


@pytest.fixture(scope="module")
def misplaced(tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, Path, corpus.Drive]:
    """A run, and its session, in a map of its building from a start 2 m off, of which 0.3 m were said."""
    drive = corpus.make_drive(corpus.Recipe.parse("office/level/absent/prior_start"), 130035)
    path = tmp_path_factory.mktemp("misplaced") / "session.db"
    session = Session.create(path, SlamConfig(), rig=drive.rig, prior=drive.prior.to_bytes())
    slam = PlaneSlam(SlamConfig(), prior=drive.prior, recorder=SessionRecorder(session))
    with closing(slam):
        run = run_slam(drive.log, drive.rig, SlamConfig(), slam=slam)
        assert run.verdict.verdict == "sound"
    return run, path, drive


def test_a_wrong_start_in_a_prior_map_is_found(misplaced: tuple[Run, Path, corpus.Drive]):
    run, path, drive = misplaced
    true = drive.truth.poses_at(run.trajectory.stamps_ns)
    off = np.linalg.inv(true) @ run.trajectory.poses
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 0.02  # 9.7 m by the start that was said
    [repair] = run.repairs
    away = inverse(drive.prior.world_T_start) @ true[0]
    assert repair.offset_m == pytest.approx(np.linalg.norm(away[:3, 3]), abs=0.01) and repair.planes > 10
    assert repair.before.startswith("the map is broken") and "it started 2 m from" in repair.sentence
    assert "start in the prior map moved by" in {row.name for row in metrics_of(run)}
    start = run.slam.prior.world_T_start
    assert (start[2, 3], start[2, 2]) == (0.0, 1.0)  # the floor, of which the start was right
    with PlaneSlam.open(path, read_only=True) as again:
        assert again.trajectory.poses.tobytes() == run.trajectory.poses.tobytes()


@pytest.mark.parametrize(("name", "asks"), [("office/level/good/prior", 0), ("office/lidar16/good/prior_elsewhere", 1)])
def test_a_right_start_is_kept_and_in_another_building_there_is_none(
    name: str, asks: int, monkeypatch: pytest.MonkeyPatch
):
    asked, remap = [], PlaneSlam.remap
    monkeypatch.setattr(PlaneSlam, "remap", lambda slam, *args: asked.append(args[1]) or remap(slam, *args))
    drive = corpus.make_drive(corpus.Recipe.parse(name), 130035)
    run = run_slam(drive.log, drive.rig, SlamConfig(), slam=PlaneSlam(SlamConfig(), prior=drive.prior))
    assert run.repairs == () and asked == [None] * asks and (run.verdict.verdict == "sound") is (asks == 0)


def test_places_that_a_user_knows_close_a_loop(frames: list[Keyframe], truth: Drive):
    """Own place recognition goes in with the keyframe; not a later place, nor a covariance that is none."""
    old, at = (truth.poses_at(np.array([frames[index].stamp_ns]))[0] for index in (OLD, AT))
    right = PlaceMatch(OLD, planar_delta(inverse(old) @ at), np.diag((0.02, 0.02, 0.004)) ** 2)
    slam = PlaneSlam(SlamConfig(loops=LoopConfig(max_candidates=0)))
    for index, frame in enumerate(frames[: AT + 1]):
        slam.add_keyframe(replace(frame, places=(right,) if index == AT else ()))
    [decision] = slam.loops
    assert (decision.keyframe, decision.old_keyframe, decision.verdict) == (AT, OLD, "known")
    for wrong in (replace(right, keyframe=AT + 1), replace(right, covariance=-right.covariance)):
        with pytest.raises(ValueError, match=r"places\[0\]"):
            slam.add_keyframe(replace(frames[AT + 1], places=(wrong,)))


def test_a_finished_run_that_is_wrong_is_open_to_repair_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """A mount that is stated backwards: scans refuse the wheels at every step. That is asked once, and not mended."""
    mission, rig, out = (tmp_path / name for name in ("log", "backwards.yaml", "run"))
    made = simulate_mission("hall", n_scans=10, seed=3)
    made.save(mission)
    turned(made.rig).to_yaml(rig)
    assert run_command(capsys, "slam", mission, "--rig", rig, "--out", out, "--no-repair")[0] == 0
    with Session.open(out, read_only=True) as session:
        assert session.result("repairs") is None
    for said in ("the map is doubtful", "finished already"):
        code, *told = run_command(capsys, "slam", "--resume", out)
        assert (code, said in "".join(told)) == (0, True)
