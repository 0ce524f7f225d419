"""The session on disk: bit for bit, one writer, readers that may be killed, nothing read that was not written."""

import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from factors.association.observations import LineObservation
from slam import PlaneSlam, SlamConfig
from slam.map.data_association import Candidate, Decision
from slam.planeslam import pose_symbol
from slam.sensors.log import CloudScan, LaserScan
from slam.session._codec import CodecError, decode, encode
from slam.session._file import digest
from slam.session.store import Session, SessionDamaged, SessionError, salvage_session
from spplanes import ScanLine
from tests.slam.scenes import drive, run_of


def assert_same_estimate(first: PlaneSlam, second: PlaneSlam) -> None:
    """Poses, planes, covariances and decisions, bit for bit."""
    assert np.array_equal(first.trajectory.poses, second.trajectory.poses)
    assert np.array_equal(first.trajectory.stamps_ns, second.trajectory.stamps_ns)
    assert [one.plane.to_dict() for one in first.planes] == [one.plane.to_dict() for one in second.planes]
    last = pose_symbol(len(first.keyframes) - 1)
    assert np.array_equal(first.marginal_covariance(last), second.marginal_covariance(last))
    assert first.decisions == second.decisions


def copy_as_killed(path: Path, copy: Path) -> None:
    """A copy of the files of a session while its writer has them open: what a kill leaves."""
    for suffix in ("", "-wal", "-shm", "-lock"):
        copy.with_name(copy.name + suffix).write_bytes(path.with_name(path.name + suffix).read_bytes())


@pytest.fixture(scope="module")
def uninterrupted() -> PlaneSlam:
    return run_of(drive(0).keyframes)


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    path = tmp_path / "session.db"
    with PlaneSlam.open(path) as slam:
        run_of(drive(0).keyframes[:7], slam)
    return path


def test_a_session_that_is_closed_is_one_file_and_goes_on_to_the_run_in_one(recorded: Path, uninterrupted: PlaneSlam):
    for last in (8, 15):
        assert [path.name for path in recorded.parent.iterdir()] == ["session.db"]
        # a rollback journal when it is written, not a write-ahead log
        assert recorded.read_bytes()[18:20] == b"\1\1"
        with PlaneSlam.open(recorded) as slam:
            run_of(drive(0).keyframes[len(slam.keyframes) : last], slam)
    assert_same_estimate(slam, uninterrupted)


def test_a_writer_that_ended_before_its_first_commit_left_a_session(tmp_path: Path):
    """Its journal is room for pages and nothing else."""
    path, copy = tmp_path / "session.db", tmp_path / "copy.db"
    with Session.create(path, SlamConfig()):
        copy_as_killed(path, copy)
    assert not any(copy.with_name(copy.name + "-wal").read_bytes())
    for read_only in (True, False):
        with Session.open(copy, read_only=read_only) as session:
            assert len(session) == 0


def test_decisions_are_recorded_and_compared(recorded: Path, uninterrupted: PlaneSlam, monkeypatch):
    with Session.open(recorded, read_only=True) as session:
        assert [entry.decisions for entry in session.entries()] == uninterrupted.decisions[:7]
    other = SlamConfig.model_validate({"association": {"gap_m": 0.0, "significance": 0.9}})
    monkeypatch.setattr(Session, "config", property(lambda self: other, lambda self, value: None), raising=False)
    with pytest.raises(SessionError, match=r"keyframe \d+, observation \d+: recorded as .*, decided again as"):
        PlaneSlam.open(recorded)


def test_measurements_are_committed_before_the_graph_uses_them(tmp_path: Path):
    """At the moment the graph first hears of a keyframe, and of its factors, another process would find them."""
    path, found = tmp_path / "session.db", []
    with PlaneSlam.open(path) as slam:
        update = slam.backend.update

        def watched(*arguments, **options):
            with sqlite3.connect(f"file:{path}?mode=ro", uri=True) as other:
                counted = "SELECT (SELECT count(*) FROM keyframes), (SELECT count(*) FROM decisions)"
                found.append(other.execute(counted).fetchone())
            return update(*arguments, **options)

        slam.backend.update = watched  # type: ignore[method-assign]
        run_of(drive(0).keyframes[:3], slam)
    assert found == [(1, 0), (1, 1), (2, 1), (2, 2), (3, 2), (3, 3)]


def test_one_writer_and_any_number_of_readers(tmp_path: Path):
    path = tmp_path / "session.db"
    frames = drive(0).keyframes
    with PlaneSlam.open(path) as writer:
        for count, keyframe in enumerate(frames[:4], 1):
            writer.add_keyframe(keyframe)
            with PlaneSlam.open(path, read_only=True) as reader:
                assert len(reader.keyframes) == count
                assert_same_estimate(reader, writer)
        with pytest.raises(SessionError, match="another process is writing it"):
            PlaneSlam.open(path)
        with PlaneSlam.open(path, read_only=True) as reader, pytest.raises(SessionError, match="to be read only"):
            reader.add_keyframe(frames[4])
        writer.add_keyframe(frames[4])
    with PlaneSlam.open(path) as writer:
        assert len(writer.keyframes) == 5


def test_a_reader_takes_back_what_a_writer_killed_while_closing_left_half_done(recorded: Path, tmp_path: Path):
    """A rollback journal beside the file, as a kill while SQLite leaves its write-ahead log makes one."""
    left = tmp_path / "left"
    left.mkdir()
    with Session.open(recorded, read_only=True) as session:
        known = len(session)
    with closing(sqlite3.connect(recorded, isolation_level=None)) as writer:
        writer.execute("PRAGMA journal_mode = DELETE")
        writer.execute("PRAGMA cache_size = 1")  # so that pages reach the disk before the end
        writer.execute("BEGIN IMMEDIATE")
        writer.execute("UPDATE keyframes SET data = zeroblob(20000)")
        assert recorded.with_name(f"{recorded.name}-journal").exists()
        for path in recorded.parent.glob(f"{recorded.name}*"):
            (left / path.name).write_bytes(path.read_bytes())
    with Session.open(left / recorded.name, read_only=True) as session:
        assert len(list(session.entries())) == known


def test_another_configuration_is_refused(recorded: Path):
    other = SlamConfig.model_validate({"association": {"gap_m": 0.1}})
    with pytest.raises(SessionError, match="expected the configuration that it was made with"):
        PlaneSlam.open(recorded, other)
    PlaneSlam.open(recorded, SlamConfig()).close()


def test_what_is_no_session_is_refused(tmp_path: Path):
    with pytest.raises(SessionError, match="expected a session, found nothing"):
        PlaneSlam.open(tmp_path / "none.db", read_only=True)
    text = tmp_path / "text.db"
    text.write_text("not a database at all " * 100)
    with pytest.raises(SessionDamaged, match="expected a session, got a damaged or foreign file"):
        PlaneSlam.open(text)
    foreign = tmp_path / "foreign.db"
    with sqlite3.connect(foreign) as other:
        other.execute("CREATE TABLE things (id INTEGER)")
    with pytest.raises(SessionError, match="expected a session, got another SQLite file"):
        PlaneSlam.open(foreign)
    assert text.read_text().startswith("not a database") and not list(tmp_path.glob("*-lock"))


@pytest.mark.parametrize(("version", "other"), [(1, "an older"), (99, "a newer")])
@pytest.mark.parametrize("read_only", [False, True], ids=["writer", "reader"])
def test_a_session_of_the_past_or_the_future_is_refused(recorded: Path, version: int, other: str, read_only: bool):
    with closing(sqlite3.connect(recorded)) as connection:
        connection.execute(f"PRAGMA user_version = {version}")
    before = recorded.read_bytes()
    with pytest.raises(SessionError, match=f"expected a session of version 3, got {version}; use {other} spplanes"):
        PlaneSlam.open(recorded, read_only=read_only)
    assert recorded.read_bytes() == before and len(list(recorded.parent.iterdir())) == 1


CHANGES = {
    "a measurement": "UPDATE keyframes SET data = zeroblob(length(data)) WHERE id = 4",
    "one bit": "UPDATE keyframes SET stamp_ns = stamp_ns + 1 WHERE id = 4",
    "a swap": "UPDATE keyframes SET data = (SELECT data FROM keyframes WHERE id = 3) WHERE id = 4",
    "a decision": "UPDATE decisions SET data = (SELECT data FROM decisions WHERE keyframe = 3) WHERE keyframe = 4",
    "a keyframe gone": "DELETE FROM keyframes WHERE id = 4",
    "decisions gone": "DELETE FROM decisions WHERE keyframe = 4",
    "the end gone": "DELETE FROM keyframes WHERE id >= 4; DELETE FROM decisions WHERE keyframe >= 4",
    "a parameter": "UPDATE session SET data = '{}' WHERE key = 'config'",
    "the program": "UPDATE session SET data = '0', digest = digest WHERE key = 'program'",
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
@pytest.mark.parametrize("read_only", [False, True], ids=["writer", "reader"])
def test_nothing_changed_is_read_as_truth(recorded: Path, change: str, read_only: bool):
    with sqlite3.connect(recorded) as other:
        other.executescript(change)
    with pytest.raises(SessionDamaged, match="damaged"):
        PlaneSlam.open(recorded, read_only=read_only)


def test_the_end_of_the_journal_is_missed(tmp_path: Path):
    """SQLite itself would read a shortened journal without a word."""
    path, copy = tmp_path / "session.db", tmp_path / "copy.db"
    with PlaneSlam.open(path) as slam:
        run_of(drive(0).keyframes[:5], slam)
        copy_as_killed(path, copy)
    files = [copy, *(copy.with_name(copy.name + suffix) for suffix in ("-wal", "-shm", "-lock"))]
    contents = [one.read_bytes() for one in files]
    assert len(contents[1]) > 4_000_000 and contents[1].endswith(bytes(4_000_000)), "room is made before it is needed"
    whole = contents[1].rstrip(b"\0")
    flipped = [bytes([*whole[:place], whole[place] ^ 1, *whole[place + 1 :]]) for place in (20_000, 0)]
    for broken in (whole[: len(whole) // 2], whole[:-30_000], *flipped, b"", None):
        for file, content in zip(files, contents, strict=True):
            file.write_bytes(content)
        files[1].write_bytes(broken) if broken is not None else files[1].unlink()
        for read_only in (True, False, False):  # who looks, or tries to go on, does not make it forgotten
            with pytest.raises(SessionDamaged, match="keyframes, the last of its journal, cannot be read"):
                Session.open(copy, read_only=read_only)
    said = salvage_session(copy)
    assert not files[3].exists()
    with Session.open(copy) as session:
        assert len(session) < 5 and f"saved {len(session)} keyframes; the damaged file is now" in said


def test_numbers_come_back_bit_for_bit():
    awkward = np.array([0.1, -0.0, np.nan, np.inf, 5e-324, np.nextafter(1.0, 2.0)])
    fortran = np.asfortranarray(np.arange(12.0).reshape(3, 4) / 3.0)
    line = ScanLine(0.3, 2.0, np.diag([1e-6, 1e-5]), np.array([[1.0, 0.5], [0.9, 2.0]]), np.arange(4), 3.3, 2)
    values = {
        "floats": [0.1, -0.0, 1e300, 5e-324, float("inf")],
        "array": awkward,
        "order": fortran,
        "small": np.array([1, -2], dtype=np.int16),
        "nested": ((1, "two", None), [True]),
        "shape": shapely.Polygon([(0.1, 0), (1, 0), (1, 1)], [[(0.3, 0.1), (0.9, 0.1), (0.9, 0.5)]]),
        "line": LineObservation(line, np.eye(4)),
        "decision": Decision(3, "match", Candidate(1, 2.5, 3, -4.0, True), (Candidate(1, 2.5, 3, -4.0, True),)),
        "number": np.float64(0.1),
        "scans": [LaserScan(5, "front", awkward, awkward), CloudScan(6, "top", fortran)],
    }
    back = decode(encode(values))
    assert back["array"].tobytes() == awkward.tobytes()
    assert np.array_equal(back["order"], fortran) and back["order"].flags.c_contiguous
    assert back["small"].dtype == np.int16 and back["small"].tolist() == [1, -2]
    assert back["nested"] == values["nested"] and back["decision"] == values["decision"]
    assert repr(back["floats"]) == repr(values["floats"])
    assert shapely.to_wkb(back["shape"]) == shapely.to_wkb(values["shape"])
    assert encode(back["line"]) == encode(values["line"]) and encode(back["scans"]) == encode(values["scans"])
    assert type(back["number"]) is float and back["number"] == 0.1


@pytest.mark.parametrize("value", [object(), {1: 2}, np.array([object()]), {"a": lambda: None}, b"bytes"])
def test_what_a_session_has_no_form_for_is_refused(value: object):
    with pytest.raises(CodecError, match="expected"):
        encode(value)


def test_no_two_sequences_have_one_digest():
    assert digest("ab", "c") != digest("a", "bc")
    assert digest(None) != digest("") != digest("None")
    assert digest(1, b"x") == digest("1", "x")


#: A reader in the middle of reading: it holds the state of the file that it sees.
_READER = """
import sys, time
from slam.session.store import Session
session = Session.open(sys.argv[1], read_only=True)
session._db.execute("BEGIN")
print(len(list(session.entries())), flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("closed_first", [False, True])
def test_a_reader_killed_while_a_run_writes(tmp_path: Path, closed_first: bool):
    path, frames = tmp_path / "session.db", drive(0).keyframes[:8]
    with Session.create(path, SlamConfig()) as session:
        for index, frame in enumerate(frames[:4]):
            session.add_keyframe(frame)
            session.add_decisions(index, [])
        reader = subprocess.Popen([sys.executable, "-c", _READER, str(path)], stdout=subprocess.PIPE, text=True)
        try:
            assert reader.stdout is not None and reader.stdout.readline() == "4\n"
            for index, frame in enumerate(frames[4:], 4):
                session.add_keyframe(frame)
                session.add_decisions(index, [])
            if closed_first:  # the reader still holds the journal, which stays
                session.close()
                assert len(list(tmp_path.glob("session.db-wal"))) == 1
        finally:
            reader.kill()
            reader.wait()
    if closed_first:
        with Session.open(path) as session:
            assert len(session) == 8
    assert [one.name for one in tmp_path.iterdir()] == ["session.db"]
    with Session.open(path, read_only=True) as session:
        assert [entry.keyframe.stamp_ns for entry in session.entries()] == [frame.stamp_ns for frame in frames]


LINE = ScanLine(0.3, 2.0, 1e-4 * np.eye(2), np.eye(2), np.arange(3))


def seen(**line: Any) -> LineObservation:
    return LineObservation(replace(LINE, **line), np.eye(4))


@pytest.mark.parametrize(
    "change",
    [
        {"notes": "dusty"},
        {"notes": (1,)},
        {"observations": [object()]},
        {"observations": [seen(dof=8.0)]},
        {"observations": [seen(dof=np.float64(8))]},
        {"observations": [seen(chi2=np.array(8.0))]},
        {"observations": [seen(dof=np.int64(8))]},
        {"observations": (seen(),)},
        {"returns": np.zeros((2, 4), dtype=bool)},
        {"returns": np.zeros((2, 4), dtype=int)},
        {"notes": ("dusty",)},
    ],
)
def test_a_session_holds_nothing_that_it_cannot_read(change: dict[str, Any], tmp_path: Path):
    """A keyframe is accepted and read again, or refused with a sentence and leaves no trace."""
    first, second, third = drive(0, count=3).keyframes
    with PlaneSlam.open(tmp_path / "session.db", SlamConfig()) as slam:
        slam.add_keyframe(first)
        try:
            slam.add_keyframe(replace(second, **change))
        except ValueError as error:
            assert "\n" not in str(error)
        count = len(slam.keyframes)
        slam.add_keyframe(third)
    with PlaneSlam.open(tmp_path / "session.db") as again:
        assert len(again.keyframes) == count + 1
        assert again.keyframes[count].stamp_ns == third.stamp_ns
