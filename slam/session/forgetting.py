"""Keyframes that are read from the session when looked at, so that memory does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from functools import lru_cache, partial

from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import Observation
from slam.lazy import Growing, Rows, Stored
from slam.map.data_association import Decision
from slam.session.store import Session

#: Keyframes that stay in memory after they were read: the last few are looked at again and again.
_KEPT = 32
#: Fields of which it is remembered whether there is anything to be read.
_PARTS = ("motion", "returns", "world_T_body_guess", "surfaces", "viewpoint")


class ForgottenKeyframes(Growing[Keyframe]):
    """Keyframes of which only the time stays, and what there is of them to be read."""

    def __init__(self, session: Session) -> None:
        read = lru_cache(maxsize=_KEPT)(session.keyframe)
        self._readers = {
            field.name: lambda index, name=field.name: getattr(read(index), name) for field in fields(Keyframe)
        }
        #: Time, number of observations, and whether there is each of `_PARTS`.
        self._known = Rows("qi" + "b" * len(_PARTS))
        #: Of keyframes with any: their notes, and those on their motion.
        self._notes: dict[int, tuple[tuple[str, ...], tuple[str, ...]]] = {}

    def __len__(self) -> int:
        return len(self._known)

    def append(self, value: Keyframe) -> None:
        """Add one whose measurements the session has."""
        if value.notes or value.motion_notes:
            self._notes[len(self)] = value.notes, value.motion_notes
        there = (getattr(value, name) is not None for name in _PARTS)
        self._known.append((int(value.stamp_ns), len(value.observations), *there))

    def at(self, index: int) -> Keyframe:
        """One of them; nothing is read yet."""
        stamp_ns, count, *there = self._known.at(index)
        seen = _StoredObservations(partial(self._readers["observations"], index), count)
        known = {"stamp_ns": stamp_ns, "observations": seen, "scans": ()}
        known["notes"], known["motion_notes"] = self._notes.get(index, ((), ()))
        known |= {name: None for name, is_there in zip(_PARTS, there, strict=True) if not is_there}
        return StoredKeyframe(known, self._readers, index)


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


class _StoredObservations(Growing[Observation]):
    """The measurements of a keyframe, whose number is known."""

    def __init__(self, read: Callable[[], Sequence[Observation]], size: int) -> None:
        self._read, self._size = read, size

    def __len__(self) -> int:
        return self._size

    def __iter__(self) -> Iterator[Observation]:
        return iter(self._read())

    def at(self, index: int) -> Observation:
        """One of them."""
        return self._read()[index]
