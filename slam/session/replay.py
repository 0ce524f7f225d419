"""What a `PlaneSlam` tells about itself while it runs: to nobody, or to a session; replaying what was recorded.

A recorder may read measurements and decisions from the session when they are looked at, so that memory does not grow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np

from slam.config import SlamConfig
from slam.frontend.keyframes import Keyframe
from slam.lazy import Growing, Stored
from slam.map.data_association import Decision
from slam.sensors.log import Log
from slam.sensors.rig import Rig
from slam.session._codec import encode
from slam.session.opening import session_path
from slam.session.prior_map import PriorMap
from slam.session.store import Places, Session, SessionError
from spplanes._check import FloatArray

#: What a session is replayed into: made of a configuration, a prior map and a recorder, and fed keyframes.
Slam = TypeVar("Slam")
RawScans = Literal["reference", "value"]
#: Numbers of a decision made again may differ by this share from those recorded; choices may not differ at all.
_SAME = 1e-9


class Recorder:
    """Listens to a `PlaneSlam`: here to nothing; a session on disk is a `SessionRecorder`.

    Whatever these methods raise ends `add_keyframe` before the graph has used what they were told.
    """

    def __init__(self) -> None:
        #: Where the estimator keeps its keyframes and its decisions: in memory.
        self.keyframes: list[Keyframe] | Growing[Keyframe] = []
        self.decisions: list[list[Decision]] | Growing[list[Decision]] = []
        #: Whether what it has was measured anew when the run had ended.
        self.is_anew = False

    def measured(self, index: int, keyframe: Keyframe) -> Keyframe:
        """The measurements of a keyframe, before anything is done with them; returns those to work with."""
        return keyframe

    def decided(self, index: int, decisions: Sequence[Decision]) -> None:
        """What each of them was taken for, before its factor is added."""

    def mended(self, places: Places, start: FloatArray | None, decisions: Sequence[Sequence[Decision]]) -> None:
        """All keyframes were matched anew with more places, or another start, known: the decisions are these now."""

    def measured_anew(self, rig: Rig, keyframes: Sequence[Keyframe], decisions: Sequence[Sequence[Decision]]) -> None:
        """All that was measured and decided is this now, with another rig."""
        self.is_anew = True

    def close(self) -> None:
        """Nothing more will come."""


class SessionRecorder(Recorder):
    """Commits what it is told; of keyframes that the session has already it checks that they come out the same.

    Args:
        session: open for writing, or read only to replay it.
        log: whose scans these are, so that each is recorded with its place there.
        raw: "reference": sensor, time and place in the log of every raw scan; "value": the scan itself as well.
        forget: keep measurements on disk alone, so that memory does not grow with them.
    """

    def __init__(
        self, session: Session, *, log: Log | None = None, raw: RawScans = "reference", forget: bool = False
    ) -> None:
        super().__init__()
        self.session, self.is_anew = session, session.is_anew
        self._by_value, self._forget = raw == "value", forget
        self._places = {} if log is None else {id(event): place for place, event in enumerate(log.events)}
        if forget:
            self.keyframes, self.decisions = ForgottenKeyframes(session), ForgottenDecisions(session)

    def measured(self, index: int, keyframe: Keyframe) -> Keyframe:
        """Commit measurements, or find them committed."""
        if index < len(self.session):
            return keyframe
        stored = self.session.add_keyframe(keyframe, self._scans_of(keyframe))
        return stored if self._forget else replace(stored, scans=keyframe.scans)

    def _scans_of(self, keyframe: Keyframe) -> list[tuple[int | None, bytes | None]]:
        return [(self._places.get(id(scan)), encode(scan) if self._by_value else None) for scan in keyframe.scans]

    def decided(self, index: int, decisions: Sequence[Decision]) -> None:
        """Commit decisions, or compare them with those committed."""
        recorded = self.session.decisions(index) if index < len(self.session) else None
        if recorded is not None:
            _check_same(f"{self.session.path}: keyframe {index}", recorded, decisions)
        elif not self.session.read_only:
            self.session.add_decisions(index, decisions)

    def mended(self, places: Places, start: FloatArray | None, decisions: Sequence[Sequence[Decision]]) -> None:
        """Commit all at once."""
        self.session.mend(places, start, decisions)

    def measured_anew(self, rig: Rig, keyframes: Sequence[Keyframe], decisions: Sequence[Sequence[Decision]]) -> None:
        """Commit all at once."""
        self.session.measure_anew(rig, [(frame, self._scans_of(frame)) for frame in keyframes], decisions)
        self.is_anew = True

    def close(self) -> None:
        """Close the session."""
        self.session.close()


def open_slam(
    kind: Callable[..., Slam], path: Path | str, config: SlamConfig | None, *, read_only: bool, forget_raw: bool
) -> Slam:
    """What `PlaneSlam.open` does."""
    path = session_path(path)
    if not path.exists() and not read_only:
        session = Session.create(path, config or SlamConfig())
    else:
        session = Session.open(path, read_only=read_only)
    try:
        if config is not None and config != session.config:
            raise SessionError(f"{path}: expected the configuration that it was made with, got another one")
        return resumed(kind, session, SessionRecorder(session, forget=forget_raw))
    except BaseException:
        session.close()
        raise


def resumed(kind: Callable[..., Slam], session: Session, recorder: SessionRecorder) -> Slam:
    """An estimator in the state that a session ended in; decisions that come out otherwise are a SessionError."""
    prior = None if session.prior is None else PriorMap.from_bytes(session.prior)
    if prior is not None and session.start is not None:
        prior = replace(prior, world_T_start=session.start)
    slam: Any = kind(session.config, prior=prior, recorder=recorder)
    for entry in session.entries():
        slam.add_keyframe(entry.keyframe)
    return slam


def is_measured_again(session: Session, index: int, keyframe: Keyframe) -> bool:
    """Whether a keyframe measured anew is the one that was recorded, bit for bit.

    Where the run was measured anew by the motion that its map had, the time alone says so.
    """
    if session.is_anew and keyframe.motion is None:
        return keyframe.stamp_ns == session.keyframe(index).stamp_ns
    again, before = replace(keyframe, scans=()), replace(session.keyframe(index), places=keyframe.places)
    return encode(again) == encode(before)


def _check_same(where: str, recorded: Sequence[Decision], decisions: Sequence[Decision]) -> None:
    for before, now in zip(recorded, decisions, strict=False):
        if _choice(before) != _choice(now) or not np.allclose(_numbers(before), _numbers(now), rtol=_SAME, atol=_SAME):
            change = f"recorded as {_say(before)}, decided again as {_say(now)}; go on with the version that began it"
            raise SessionError(f"{where}, observation {now.observation}: {change}")
    if len(recorded) != len(decisions):
        raise SessionError(f"{where}: expected {len(recorded)} decisions, got {len(decisions)}")


def _choice(decision: Decision) -> tuple[Any, ...]:
    found = tuple((candidate.landmark, candidate.dof, candidate.confirmed) for candidate in decision.candidates)
    return decision.observation, decision.verdict, decision.landmark, found


def _numbers(decision: Decision) -> list[float]:
    return [number for candidate in decision.candidates for number in (candidate.chi2, candidate.log_likelihood)]


def _say(decision: Decision) -> str:
    return decision.verdict if decision.match is None else f"landmark {decision.match.landmark}"


class ForgottenKeyframes(Growing[Keyframe]):
    """Keyframes of which the time, the notes, and what there is not stay; the last few that were read are kept."""

    def __init__(self, session: Session) -> None:
        read = lru_cache(maxsize=32)(session.keyframe)  # the last few are looked at again and again
        self._readers = {
            field.name: lambda index, name=field.name: getattr(read(index), name) for field in fields(Keyframe)
        }
        self._known: list[dict[str, Any]] = []

    def __len__(self) -> int:
        return len(self._known)

    def append(self, value: Keyframe) -> None:
        """Add one whose measurements the session has."""
        known = {"stamp_ns": int(value.stamp_ns), "notes": value.notes, "scans": ()}
        self._known.append(known | {name: None for name in self._readers if getattr(value, name) is None})

    def at(self, index: int) -> Keyframe:
        """One of them; nothing is read yet."""
        return StoredKeyframe(self._known[index], self._readers, index)


class StoredKeyframe(Stored, Keyframe):
    """A keyframe that was recorded: what it measured is read from the session when it is asked for."""


class ForgottenDecisions(Growing[list[Decision]]):
    """Decisions that the session has; the last ones stay, for who only looks may know them before the session does."""

    def __init__(self, session: Session) -> None:
        self._session, self._size = session, 0
        self._last: list[Decision] = []

    def __len__(self) -> int:
        return self._size

    def append(self, value: list[Decision]) -> None:
        """Add those of one keyframe."""
        self._last, self._size = value, self._size + 1

    def at(self, index: int) -> list[Decision]:
        """Those of one keyframe."""
        found = None if index == self._size - 1 else self._session.decisions(index)
        return self._last if found is None else found
