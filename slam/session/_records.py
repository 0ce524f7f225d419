"""What a session tells: every record checked against its checksum whenever it is read."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from slam.config import SlamConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.pose_measurements import PlaceMatch
from slam.map.data_association import Decision
from slam.sensors.log import CloudScan, LaserScan
from slam.sensors.rig import Rig
from slam.session._codec import decode, keyframe_of
from slam.session._file import SessionDamaged, SessionError, digest, translated
from slam.session.opening import OpenFile
from spplanes._check import FloatArray, as_transform

#: Places by the keyframe that stands near them.
Places = Mapping[int, Sequence[PlaceMatch]]
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
    stamp_ns: int
    position: int | None
    """Its place among the events of the log, counted from 0; None: it came from no log."""
    scan: LaserScan | CloudScan | None
    """The scan itself, where the session keeps it by value."""


class SessionRecords:
    """The records of an open session; all methods raise `SessionError`."""

    def __init__(self, path: Path, found: OpenFile, *, damaged: bool = False) -> None:
        self.path, self._file, self._db = path, found, found.connection
        with translated(path), self._db:
            self._db.execute("BEGIN")  # one state of the file, whatever its writer does meanwhile
            self._load(damaged)

    def _load(self, damaged: bool) -> None:
        parameters = {key: self._read("session", key) for key in _PARAMETERS}
        try:
            self.config = SlamConfig.model_validate(json.loads(parameters["config"] or b"null"))
            self.rig = Rig.model_validate_json(parameters["rig"]) if parameters["rig"] is not None else None
        except ValueError as error:
            raise SessionError(f"{self.path}: expected the parameters of a run, got others") from error
        self.prior = parameters["prior"]
        of_places = partial(decode, hint=list[tuple[int, tuple[PlaceMatch, ...]]])
        places = self._checked(of_places, self._read("session", "places"), "the places that were found")
        #: Places found after the drive, by the keyframe that stands near them; a keyframe is read with its own.
        self.places = dict(places or ())
        #: Start in the prior map, shape (4, 4), found after the drive; None: the one that the prior map says.
        self.start = self._checked(_pose_of, self._read("session", "start"), "the start that was found")
        self._last = b""
        self._root = self._first_digest()
        if damaged:  # nobody knows how many there were
            self._size = sys.maxsize
            return
        self._size = int(self._one("SELECT count(*) FROM keyframes")[0])
        self._last = self._digest_of(self._size - 1)
        self._check_seal()

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
    def is_anew(self) -> bool:
        """Whether all that it has was measured anew when the run had ended."""
        return self._read("session", "anew") is not None

    @property
    def log(self) -> dict[str, Any] | None:
        """Where the data come from, as given to `create`."""
        return json.loads(self._read("session", "log") or b"null")

    def entries(self) -> Iterator[Entry]:
        """All keyframes with their decisions, in order, up to a SessionDamaged at what is not as it was written."""
        for index in range(self._size):
            yield Entry(self.keyframe(index), self.decisions(index))

    def keyframe(self, index: int) -> Keyframe:
        """The measurements of one keyframe, with the places that were found for it since."""
        row = self._one("SELECT stamp_ns, data, digest FROM keyframes WHERE id = ?", index)
        if row is None or digest(self._digest_of(index - 1), index, row[0], row[1]) != row[2]:
            raise self._damaged(index)
        measured = self._checked(keyframe_of, row[1], f"keyframe {index}")
        return replace(measured, places=self.places[index]) if index in self.places else measured

    def decisions(self, index: int) -> list[Decision] | None:
        """What the measurements of a keyframe were taken for; None: not recorded."""
        row = self._one("SELECT data, digest FROM decisions WHERE keyframe = ?", index)
        if row is None:
            if index < self._size - 1 < sys.maxsize - 1:
                raise self._damaged(index)
            return None
        if digest(self._digest_of(index), row[0]) != row[1]:
            raise self._damaged(index)
        return self._checked(partial(decode, hint=list[Decision]), row[0], f"keyframe {index}")

    def scans(self, index: int) -> list[RawScan]:
        """The raw scans behind a keyframe: what they are, where they lie in the log, and they themselves if kept."""
        with translated(self.path):
            columns = "number, sensor, stamp_ns, position, data, digest"
            query = f"SELECT {columns} FROM scans WHERE keyframe = ? ORDER BY number"
            rows = self._db.execute(query, (index,)).fetchall()
        found, read = [], partial(decode, hint=LaserScan | CloudScan)
        for *row, checksum in rows:
            if digest(self._digest_of(index), *row) != checksum:
                raise self._damaged(index)
            _, sensor, stamp_ns, position, data = row
            found.append(RawScan(sensor, stamp_ns, position, self._checked(read, data, f"keyframe {index}")))
        return found

    def result(self, key: str) -> bytes | None:
        """Something that `finish` kept."""
        return self._read("results", key)

    @property
    def _state(self) -> dict[str, Any]:
        return json.loads(self._read("session", "state") or b'{"state": "running", "keyframes": 0}')

    def _check_seal(self) -> None:
        seal = self._state
        extra = self._one("SELECT count(*) FROM decisions WHERE keyframe >= ?", self._size)[0]
        if self._size < seal["keyframes"] or extra:
            raise self._damaged(self._size, max(seal["keyframes"], self._size + extra))
        if seal["keyframes"] and self._digest_of(seal["keyframes"] - 1).hex() != seal["chain"]:
            raise self._damaged(seal["keyframes"] - 1)

    def _one(self, query: str, *values: object) -> Any:
        with translated(self.path):
            return self._db.execute(query, values).fetchone()

    def _read(self, table: str, key: str) -> bytes | None:
        row = self._one(f"SELECT data, digest FROM {table} WHERE key = ?", key)
        if row is not None and digest(key, row[0]) != row[1]:
            raise SessionDamaged(f"{self.path}: damaged; the record of its {key} is not what was written")
        return None if row is None else row[0]

    def _first_digest(self) -> bytes:
        """Of the parameters of the run, with which the chain of checksums begins."""
        return digest(*(self._read("session", key) for key in _PARAMETERS))

    def _digest_of(self, index: int) -> bytes:
        if index < 0:
            return self._root
        if index == self._size - 1 and self._last:
            return self._last
        row = self._one("SELECT digest FROM keyframes WHERE id = ?", index)
        if row is None or not isinstance(row[0], bytes):
            raise self._damaged(index)
        return row[0]

    def _checked(self, read: Callable[[bytes], Any], data: bytes | None, what: str) -> Any:
        """What a record says; None: there is none."""
        try:
            return None if data is None else read(data)
        except ValueError as error:  # as a CodecError is
            raise SessionError(f"{self.path}: {what}: {error}") from error

    def _damaged(self, index: int, size: int | None = None) -> SessionDamaged:
        return SessionDamaged(f"{self.path}: damaged at keyframe {index} of {size or self._size}")


def _pose_of(data: bytes) -> FloatArray:
    return as_transform("start", decode(data))
