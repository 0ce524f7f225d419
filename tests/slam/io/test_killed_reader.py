"""A reader that is killed while a run writes leaves nothing behind that hurts the run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from slam import SlamConfig
from slam.session.store import Session
from tests.slam.scenes import drive

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
