"""A run on disk: what every keyframe measured and what it was taken for, committed before the graph uses it."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from slam._session_codec import CodecError, decode, encode, keyframe_of, without_scans
from slam._session_digest import digest
from slam._session_file import SessionDamaged, SessionError, StorageError, transaction, translated
from slam._session_open import OpenFile, make_file, open_file, put
from slam.association import Decision
from slam.config import SlamConfig
from slam.io.log import CloudScan, LaserScan
from slam.keyframes import Keyframe
from slam.rig import Rig
from spplanes import __version__

__all__ = ["Entry", "Session", "SessionDamaged", "SessionError", "StorageError", "session_path"]

#: Name of the session in the folder of a run.
SESSION_FILE = "session.db"
#: Parameters in the order in which the chain of checksums begins with them.
_PARAMETERS = ("config", "rig", "prior", "program")


@dataclass(frozen=True, eq=False)
class Entry:
    """What a session knows about one keyframe."""

    keyframe: Keyframe
    """Its measurements, without the raw scans."""
    decisions: list[Decision] | None
    """What they were taken for; None: the run ended before that was known."""


@dataclass(frozen=True, eq=False)
class RawScan:
    """A raw scan behind a keyframe."""

    sensor: str
    """Name of the sensor."""
    stamp_ns: int
    """Time of the scan, ns."""
    position: int | None
    """Its place among the events of the log, counted from 0; None: it came from no log."""
    scan: LaserScan | CloudScan | None
    """The scan itself, where the session keeps it by value."""


def session_path(path: Path | str) -> Path:
    """The session file: the path itself, or session.db in the folder of a run."""
    path = Path(path)
    return path / SESSION_FILE if path.is_dir() else path


class Session:
    """The file of a run. One process writes it, others may read it meanwhile; all methods raise `SessionError`.

    Every record carries a checksum over itself and all before it, which is checked whenever it is read.
    """

    def __init__(self, path: Path, found: OpenFile, *, damaged: bool = False) -> None:
        self.path, self._file = path, found
        self._db, self._version = found.connection, found.version
        with translated(path):
            self._db.execute("BEGIN")  # one state of the file, whatever its writer does meanwhile
        try:
            self._load(damaged)
        finally:
            with translated(path):
                if self._db.in_transaction:
                    self._db.execute("COMMIT")

    def _load(self, damaged: bool) -> None:
        parameters = {key: self._read("session", key) for key in _PARAMETERS}
        try:
            self.config = SlamConfig.model_validate(json.loads(parameters["config"] or b"null"))
            self.rig = Rig.model_validate_json(parameters["rig"]) if parameters["rig"] is not None else None
        except ValueError as error:
            raise SessionError(f"{self.path}: expected the parameters of a run, got others") from error
        self.prior = parameters["prior"]
        self._root = digest(*(parameters[key] for key in _PARAMETERS))
        if damaged:  # nobody knows how many there were
            self._size, self._last = sys.maxsize, b""
            return
        self._size = int(self._one("SELECT count(*) FROM keyframes")[0])
        self._last = self._digest_of(self._size - 1)
        self._check_seal()

    @classmethod
    def create(
        cls,
        path: Path | str,
        config: SlamConfig,
        *,
        rig: Rig | None = None,
        prior: bytes | None = None,
        log: dict[str, Any] | None = None,
    ) -> Self:
        """A new session with the parameters of a run; an existing file is refused.

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
            "rig": None if rig is None else _rig_json(rig),
            "prior": prior,
            "program": __version__.encode(),
            "log": json.dumps(log).encode(),
            "state": json.dumps({"state": "running", "keyframes": 0}).encode(),
        }
        make_file(path, {key: value for key, value in values.items() if value is not None})
        return cls.open(path)

    @classmethod
    def open(cls, path: Path | str, *, read_only: bool = False, damaged: bool = False) -> Self:
        """A session that exists; a writer brings an older version up to today's.

        Args:
            path: the file, or the folder of a run.
            read_only: only look; another process may be writing meanwhile.
            damaged: it is known to be, and each record is to be asked for by itself (see `slam.salvage`).

        Raises:
            SessionError: no such file, no session, another process writes it (and this one wants to).
            SessionDamaged: a checksum fails.
        """
        path = session_path(path)
        if not path.is_file():
            raise SessionError(f"{path}: expected a session, found nothing")
        found = open_file(path, read_only=read_only, damaged=damaged)
        try:
            return cls(path, found, damaged=damaged)
        except BaseException:
            found.close()
            raise

    def __len__(self) -> int:
        """Number of keyframes recorded, as of opening when another process writes."""
        return self._size

    @property
    def read_only(self) -> bool:
        """Whether it was opened to be read."""
        return self._file.lock is None

    @property
    def is_finished(self) -> bool:
        """Whether the run came to its end, results written."""
        return self._state["state"] == "finished"

    @property
    def log(self) -> dict[str, Any] | None:
        """Where the data come from, as given to `create`."""
        return json.loads(self._read("session", "log") or b"null")

    def entries(self) -> Iterator[Entry]:
        """All keyframes with their decisions, in order.

        Raises:
            SessionDamaged: at the first record that is not what was written; those before it have been given.
        """
        chain = self._root
        for index in range(self._size):
            row = self._one("SELECT stamp_ns, data, digest FROM keyframes WHERE id = ?", index)
            chain = digest(chain, index, row[0], row[1]) if row is not None else b""
            if row is None or chain != row[2]:
                raise self._damaged(index)
            yield Entry(self._checked(keyframe_of, row[1], index), self.decisions(index, chain))

    def keyframe(self, index: int) -> Keyframe:
        """The measurements of one keyframe."""
        row = self._one("SELECT stamp_ns, data, digest FROM keyframes WHERE id = ?", index)
        if row is None or digest(self._digest_of(index - 1), index, row[0], row[1]) != row[2]:
            raise self._damaged(index)
        return self._checked(keyframe_of, row[1], index)

    def decisions(self, index: int, chain: bytes | None = None) -> list[Decision] | None:
        """What the measurements of a keyframe were taken for; None: not recorded."""
        row = self._one("SELECT data, digest FROM decisions WHERE keyframe = ?", index)
        if row is None:
            if index < self._size - 1 < sys.maxsize - 1:
                raise self._damaged(index)
            return None
        if digest(chain or self._digest_of(index), row[0]) != row[1]:
            raise self._damaged(index)
        return self._checked(decode, row[0], index)

    def scans(self, index: int) -> list[RawScan]:
        """The raw scans behind a keyframe: what they are, where they lie in the log, and they themselves if kept."""
        if self._version < 2:
            return []
        with translated(self.path):
            rows = self._db.execute(
                "SELECT number, sensor, stamp_ns, position, data, digest FROM scans WHERE keyframe = ? ORDER BY number",
                (index,),
            ).fetchall()
        found = []
        for *row, checksum in rows:
            if digest(self._digest_of(index), *row) != checksum:
                raise self._damaged(index)
            _, sensor, stamp_ns, position, data = row
            scan = None if data is None else self._checked(decode, data, index)
            found.append(RawScan(sensor, stamp_ns, position, scan))
        return found

    def add_keyframe(self, keyframe: Keyframe, scans: Sequence[tuple[int | None, bytes | None]] = ()) -> Keyframe:
        """Record measurements; returns the keyframe as it will be read, which is what to work with.

        Args:
            keyframe: with its raw scans.
            scans: place in the log and content of each of them, as far as they are to be kept.
        """
        self._check_writable()
        index, data = self._size, encode(without_scans(keyframe))
        checksum = digest(self._last, index, keyframe.stamp_ns, data)
        with transaction(self.path, self._db):
            self._db.execute(
                "INSERT INTO keyframes VALUES (?, ?, ?, ?)", (index, int(keyframe.stamp_ns), data, checksum)
            )
            for number, (scan, kept) in enumerate(zip(keyframe.scans, scans, strict=False)):
                row = (number, scan.sensor, int(scan.stamp_ns), *kept)
                self._db.execute(
                    "INSERT INTO scans VALUES (?, ?, ?, ?, ?, ?, ?)", (index, *row, digest(checksum, *row))
                )
        self._size, self._last = index + 1, checksum
        return keyframe_of(data)

    def add_decisions(self, index: int, decisions: Sequence[Decision]) -> None:
        """Record what the measurements of a keyframe were taken for."""
        self._check_writable()
        data = encode(list(decisions))
        row = (index, data, digest(self._digest_of(index), data))
        with self._on_the_way():
            self._db.execute("INSERT INTO decisions VALUES (?, ?, ?)", row)

    @contextmanager
    def _on_the_way(self) -> Iterator[None]:
        """A commit that outlives the process at once, and a power cut from the next keyframe's commit on."""
        with translated(self.path):
            self._db.execute("PRAGMA synchronous = NORMAL")
            try:
                with transaction(self.path, self._db):
                    yield
            finally:
                self._db.execute("PRAGMA synchronous = FULL")

    def result(self, key: str) -> bytes | None:
        """Something that `finish` kept."""
        return self._read("results", key) if self._version >= 2 else None

    def finish(self, **results: bytes) -> None:
        """The run came to its end; `results` are kept with it."""
        self._check_writable()
        with transaction(self.path, self._db):
            for key, data in results.items():
                put(self._db, "results", key, data)
            self._seal("finished")

    def set_log(self, log: dict[str, Any]) -> None:
        """Say anew where the data come from."""
        self._check_writable()
        with transaction(self.path, self._db):
            put(self._db, "session", "log", json.dumps(log).encode())

    def close(self) -> None:
        """Let go of the file; what a writer leaves is one file without journal. Twice is once."""
        if self._file.lock is None:
            self._file.close()
            return
        try:
            if not self.is_finished:
                with transaction(self.path, self._db):
                    self._seal("running")
            with translated(self.path):
                self._db.execute("PRAGMA journal_mode = DELETE")
        except (SessionError, StorageError):
            pass  # a reader holds it, the disk is full, or it is closed: the journal stays and is as good
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def _state(self) -> dict[str, Any]:
        return json.loads(self._read("session", "state") or b'{"state": "running", "keyframes": 0}')

    def _seal(self, state: str) -> None:
        """Write down how far it goes: what is missing from the end has no checksum of its own."""
        seal = {"state": state, "keyframes": self._size, "chain": self._last.hex()}
        put(self._db, "session", "state", json.dumps(seal).encode())

    def _check_seal(self) -> None:
        seal = self._state
        extra = self._one("SELECT count(*) FROM decisions WHERE keyframe >= ?", self._size)[0]
        if self._size < seal["keyframes"] or extra:
            raise self._damaged(self._size, max(seal["keyframes"], self._size + extra))
        if seal["keyframes"] and self._digest_of(seal["keyframes"] - 1).hex() != seal["chain"]:
            raise self._damaged(seal["keyframes"] - 1)

    def _check_writable(self) -> None:
        if self._file.lock is None:
            raise SessionError(f"{self.path}: opened to be read only")

    def _one(self, query: str, *values: object) -> Any:
        with translated(self.path):
            return self._db.execute(query, values).fetchone()

    def _read(self, table: str, key: str) -> bytes | None:
        row = self._one(f"SELECT data, digest FROM {table} WHERE key = ?", key)
        if row is not None and digest(key, row[0]) != row[1]:
            raise SessionDamaged(f"{self.path}: damaged; the record of its {key} is not what was written")
        return None if row is None else row[0]

    def _digest_of(self, index: int) -> bytes:
        if index < 0:
            return self._root
        row = self._one("SELECT digest FROM keyframes WHERE id = ?", index)
        if row is None:
            raise self._damaged(index)
        return row[0]

    def _checked(self, read: Any, data: bytes, index: int) -> Any:
        try:
            return read(data)
        except CodecError as error:
            raise SessionError(f"{self.path}: keyframe {index}: {error}") from error

    def _damaged(self, index: int, size: int | None = None) -> SessionDamaged:
        return SessionDamaged(f"{self.path}: damaged at keyframe {index} of {size or self._size}")


def _rig_json(rig: Rig) -> bytes:
    plain = rig.model_dump(mode="json", by_alias=True, exclude_none=True)
    for sensor in plain["sensors"].values():
        sensor["body_T_sensor"] = sensor["body_T_sensor"].get("matrix", sensor["body_T_sensor"])
    return json.dumps(plain).encode()
