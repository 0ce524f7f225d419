"""The session: what every keyframe measured and what it was taken for, on disk before the graph uses it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any, Self

from slam.config import SlamConfig
from slam.frontend.keyframes import Keyframe
from slam.map.data_association import Decision
from slam.sensors.rig import Rig
from slam.session._codec import encode, keyframe_of, without_scans
from slam.session._file import (
    SessionDamaged,
    SessionError,
    StorageError,
    digest,
    fold_journal,
    translated,
)
from slam.session._records import Entry, Places, RawScan, SessionRecords
from slam.session.opening import given_session, make_file, open_file, promise, put, session_path, writing
from spplanes import __version__
from spplanes._check import FloatArray

__all__ = ["Entry", "RawScan", "Session", "SessionDamaged", "SessionError", "StorageError"]

#: Files of a session.
_SUFFIXES = ("", "-wal", "-shm")


class Session(SessionRecords):
    """The file of a run. One process writes it, others may read it meanwhile; all methods raise `SessionError`.

    Every record carries a checksum over itself and all before it, which is checked whenever it is read.
    """

    @classmethod
    def create(cls, path: Path | str, config: SlamConfig, **begun_with: Any) -> Self:
        """A new session, open for writing; with what `make` takes."""
        cls.make(path, config, **begun_with)
        return cls.open(path)

    @staticmethod
    def make(
        path: Path | str,
        config: SlamConfig,
        *,
        rig: Rig | None = None,
        prior: bytes | None = None,
        log: dict[str, Any] | None = None,
    ) -> None:
        """The file of a new session with the parameters of a run; an existing file is refused.

        Args:
            path: the file to make.
            config: of the estimator.
            rig: of the robot, where the session shall resume with its log alone.
            prior: a `PriorMap` as bytes.
            log: where the data come from, in terms of JSON.
        """
        path = session_path(path)
        if path.exists():
            raise SessionError(f"{path}: exists already")
        values = {
            "config": json.dumps(config.model_dump(mode="json")).encode(),  # JSON of Python's: it knows infinity
            "rig": None if rig is None else json.dumps(rig.to_plain()).encode(),
            "prior": prior,
            "program": __version__.encode(),
            "log": json.dumps(log).encode(),
            "state": json.dumps({"state": "running", "keyframes": 0}).encode(),
        }
        make_file(path, {key: value for key, value in values.items() if value is not None})

    @classmethod
    def open(cls, path: Path | str, *, read_only: bool = False, damaged: bool = False) -> Self:
        """A session that exists.

        Args:
            path: the file, or the folder of a run.
            read_only: only look; another process may be writing meanwhile.
            damaged: it is known to be, and each record is to be asked for by itself (see `salvage_session`).

        Raises:
            SessionError: no such file, no session, another process writes it (and this one wants to).
            SessionDamaged: a checksum fails.
        """
        path = given_session(path)
        found = open_file(path, read_only=read_only, damaged=damaged)
        try:
            return cls(path, found, damaged=damaged)
        except BaseException:
            found.opened.close()
            raise

    def add_keyframe(self, keyframe: Keyframe, scans: Sequence[tuple[int | None, bytes | None]] = ()) -> Keyframe:
        """Record measurements; returns the keyframe as it will be read, without its scans: what to work with.

        `scans`: place in the log and content of each of its raw scans, as far as they are to be kept.
        """
        data = encode(without_scans(keyframe))
        read = keyframe_of(data)  # before it is written: it can be read
        with self._writing():
            checksum = self._put_keyframe(self._size, self._last, keyframe, data, scans)
        self._size, self._last = self._size + 1, checksum
        if self._file.lock is not None:
            promise(self._file.lock, self._size)
        return read

    def _put_keyframe(
        self,
        index: int,
        before: bytes,
        keyframe: Keyframe,
        data: bytes,
        scans: Sequence[tuple[int | None, bytes | None]],
    ) -> bytes:
        """The checksum of a keyframe, after that of the one before it."""
        checksum = digest(before, index, keyframe.stamp_ns, data)
        self._insert("keyframes", index, int(keyframe.stamp_ns), data, checksum)
        for number, (scan, kept) in enumerate(zip(keyframe.scans, scans, strict=False)):
            row = (number, scan.sensor, int(scan.stamp_ns), *kept)
            self._insert("scans", index, *row, digest(checksum, *row))
        return checksum

    def add_decisions(self, index: int, decisions: Sequence[Decision]) -> None:
        """Record what the measurements of a keyframe were taken for."""
        with self._on_the_way():
            self._put_decisions(index, decisions)

    def mend(self, places: Places, start: FloatArray | None, decisions: Sequence[Sequence[Decision]]) -> None:
        """Record places, and a start in the prior map, found after the drive, and all decisions with them known.

        One transaction: a session is the one that it was, or the one that is replayed to the mended map; until `finish`
        it has no results.
        """
        known = {**self.places, **{index: tuple(found) for index, found in places.items()}}
        data = encode([(index, found) for index, found in sorted(known.items())])
        with self._writing():
            put(self._db, "session", "places", data)
            if start is not None:
                put(self._db, "session", "start", encode(start))
            self._db.execute("DELETE FROM decisions")
            for index, decision in enumerate(decisions):
                self._put_decisions(index, decision)
            self._seal("running")
        self.places, self.start = known, self.start if start is None else start

    def measure_anew(
        self,
        rig: Rig,
        measured: Sequence[tuple[Keyframe, Sequence[tuple[int | None, bytes | None]]]],
        decisions: Sequence[Sequence[Decision]],
    ) -> None:
        """Record all keyframes, as `add_keyframe` takes them, with another rig, in place of those that were.

        One transaction: a session is the one that it was, or the other.
        """
        before = self._root, self._size, self._last
        try:
            with self._writing():
                put(self._db, "session", "rig", json.dumps(rig.to_plain()).encode())
                put(self._db, "session", "anew", b"")
                for table in ("decisions", "scans", "keyframes"):
                    self._db.execute(f"DELETE FROM {table}")
                self._root = self._last = self._first_digest()
                for index, (keyframe, scans) in enumerate(measured):
                    self._last = self._put_keyframe(index, self._last, keyframe, encode(without_scans(keyframe)), scans)
                    self._size = index + 1
                for index, decision in enumerate(decisions):
                    self._put_decisions(index, decision)
                self._seal("running")
        except BaseException:
            self._root, self._size, self._last = before
            raise
        self.rig = rig

    def _put_decisions(self, index: int, decisions: Sequence[Decision]) -> None:
        data = encode(list(decisions))
        self._insert("decisions", index, data, digest(self._digest_of(index), data))

    def _insert(self, table: str, *values: object) -> None:
        self._db.execute(f"INSERT INTO {table} VALUES ({', '.join('?' * len(values))})", values)

    @contextmanager
    def _on_the_way(self) -> Iterator[None]:
        """A commit that outlives the process at once, and a power cut from the next keyframe's commit on."""
        with translated(self.path):
            self._db.execute("PRAGMA synchronous = NORMAL")
            try:
                with self._writing():
                    yield
            finally:
                self._db.execute("PRAGMA synchronous = FULL")

    def finish(self, **results: bytes) -> None:
        """The run came to its end; `results` are kept with it."""
        with self._writing():
            for key, data in results.items():
                put(self._db, "results", key, data)
            self._seal("finished")

    def set_log(self, log: dict[str, Any]) -> None:
        """Say anew where the data come from."""
        with self._writing():
            put(self._db, "session", "log", json.dumps(log).encode())

    def close(self) -> None:
        """Let go of the file; what a writer leaves is one file without journal. Twice is once."""
        with self._file.opened, suppress(SessionError, StorageError):
            # a reader holds it, the disk is full, or it is closed: the journal stays and is as good
            if self._file.lock is None:
                return
            if not self.is_finished:
                with self._on_the_way():  # to fold the journal back begins with a sync of it
                    self._seal("running")
            with translated(self.path):
                if fold_journal(self._db):
                    promise(self._file.lock, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _seal(self, state: str) -> None:
        """Write down how far it goes: what is missing from the end has no checksum of its own."""
        seal = {"state": state, "keyframes": self._size, "chain": self._last.hex()}
        put(self._db, "session", "state", json.dumps(seal).encode())

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """All or nothing, and on the disk when the block has ended."""
        if self.read_only:
            raise SessionError(f"{self.path}: opened to be read only")
        with translated(self.path), self._db:
            self._db.execute("BEGIN IMMEDIATE")
            yield


def salvage_session(path: Path | str) -> str:
    """Make a session of the longest valid beginning of a damaged one, in its place; the old one stays beside it.

    Decisions, raw scans and parameters come along. A session without damage is left as it is. Returns a sentence on
    what was wrong and how many keyframes it has now; a SessionError where nothing of it can be read or others write it.
    """
    path = given_session(path)
    try:
        with Session.open(path) as session:
            for _ in session.entries():
                pass
            for index in range(len(session)):
                session.scans(index)
            return f"nothing is damaged; {len(session)} keyframes"
    except SessionDamaged as error:
        damage = str(error)
    work, kept = path.with_name(path.name + ".salvaged"), path.with_name(path.name + ".damaged")
    with writing(path) as lock:
        try:
            saved = _copy_beginning(path, work)
            for suffix in _SUFFIXES:
                if path.with_name(path.name + suffix).exists():
                    os.replace(path.with_name(path.name + suffix), kept.with_name(kept.name + suffix))
            os.replace(work, path)
            promise(lock, 0)
        finally:
            for suffix in (*_SUFFIXES, "-lock"):
                work.with_name(work.name + suffix).unlink(missing_ok=True)
    return f"{damage}; saved {saved} keyframes; the damaged file is now {kept.name}"


def _copy_beginning(path: Path, target: Path) -> int:
    """Copy keyframes until one is damaged; returns how many there are."""
    with (
        Session.open(path, read_only=True, damaged=True) as old,
        Session.create(target, old.config, rig=old.rig, prior=old.prior, log=old.log) as new,
    ):
        if old.start is not None:
            new.mend({}, old.start, ())
        for index in count():
            try:
                keyframe = old.keyframe(index)
            except SessionDamaged:
                break
            scans: tuple[RawScan, ...] = ()
            with suppress(SessionDamaged):  # raw scans are beside the point
                scans = tuple(old.scans(index))
            contents = [(scan.position, None if scan.scan is None else encode(scan.scan)) for scan in scans]
            new.add_keyframe(replace(keyframe, scans=scans), contents)  # type: ignore[arg-type]  # they know as much
            try:
                decisions = old.decisions(index)
            except SessionDamaged:  # they will be made again
                break
            if decisions is None:
                break
            new.add_decisions(index, decisions)
        return len(new)
