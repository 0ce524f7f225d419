"""Keyframes that are read from the session when looked at, so that memory does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial
from typing import Any, overload

from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import Observation
from slam.frontend.odometry import Motion
from slam.frontend.pose_measurements import PlaceMatch, PoseMeasurement
from slam.growable import Growing, Rows
from slam.map.data_association import Decision
from slam.session.store import Session
from spplanes._check import FloatArray

#: Keyframes that stay in memory after they were read: the last few are looked at again and again.
_KEPT = 32

Read = Callable[[], Keyframe]
_Notes = tuple[tuple[str, ...], tuple[str, ...]]


class ForgottenKeyframes(Growing[Keyframe]):
    """Keyframes of which only the time stays, and what there is of them to be read."""

    def __init__(self, session: Session) -> None:
        self._read = lru_cache(maxsize=_KEPT)(session.keyframe)
        #: Time, number of observations, whether there are a motion, returns, a guess of the pose, and surfaces.
        self._known = Rows("qibbbb")
        #: Of keyframes with any: their notes, and those on their motion.
        self._notes: dict[int, _Notes] = {}

    def __len__(self) -> int:
        return len(self._known)

    def append(self, value: Keyframe) -> None:
        """Add one whose measurements the session has."""
        if value.notes or value.motion_notes:
            self._notes[len(self)] = value.notes, value.motion_notes
        parts = (value.motion, value.returns, value.world_T_body_guess, value.surfaces)
        there = (part is not None for part in parts)
        self._known.append((int(value.stamp_ns), len(value.observations), *there))

    def at(self, index: int) -> Keyframe:
        """One of them; nothing is read yet."""
        stamp_ns, count, *there = self._known.at(index)
        return StoredKeyframe(stamp_ns, count, self._notes.get(index, ((), ())), partial(self._read, index), there)


class StoredKeyframe(Keyframe):
    """A keyframe that was recorded: what it measured is read from the session when it is asked for."""

    def __new__(cls, *given: Any, **fields: Any) -> Any:
        """Of the fields of a keyframe, as `dataclasses.replace` gives them, one in memory."""
        return Keyframe(**fields) if "motion" in fields else super().__new__(cls)

    def __init__(self, stamp_ns: int, count: int, notes: _Notes, read: Read, there: Sequence[int]) -> None:
        seen = _StoredObservations(read, count)
        known: dict[str, Any] = {"stamp_ns": stamp_ns, "observations": seen, "scans": ()}
        known["notes"], known["motion_notes"] = notes
        for name, value in {**known, "_read": read, "_there": there}.items():
            object.__setattr__(self, name, value)  # frozen: set once, here

    def __repr__(self) -> str:
        return f"StoredKeyframe(stamp_ns={self.stamp_ns})"  # without reading it

    @property
    def motion(self) -> Motion | None:  # type: ignore[override]  # a field there, read each time here
        """Motion from the keyframe before; None for the first one, and where nobody measured it."""
        return self._read().motion if self._there[0] else None  # type: ignore[attr-defined]

    @property
    def returns(self) -> FloatArray | None:  # type: ignore[override]
        """Beams that met a surface, rows (x0, y0, x1, y1), shape (N, 4), m; None: no such laser."""
        return self._read().returns if self._there[1] else None  # type: ignore[attr-defined]

    @property
    def world_T_body_guess(self) -> FloatArray | None:  # type: ignore[override]
        """Where the first pose is, shape (4, 4); None: at the origin."""
        return self._read().world_T_body_guess if self._there[2] else None  # type: ignore[attr-defined]

    @property
    def pose_measurements(self) -> Sequence[PoseMeasurement]:  # type: ignore[override]
        """What is known of the pose beside motion and planes."""
        return self._read().pose_measurements  # type: ignore[attr-defined]

    @property
    def places(self) -> Sequence[PlaceMatch]:  # type: ignore[override]
        """Earlier keyframes that it is known to stand near."""
        return self._read().places  # type: ignore[attr-defined]

    @property
    def surfaces(self) -> FloatArray | None:  # type: ignore[override]
        """Surface elements of a 3D scan, shape (N, 8); None: no 3D scan."""
        return self._read().surfaces if self._there[3] else None  # type: ignore[attr-defined]

    @property
    def viewpoint(self) -> FloatArray | None:  # type: ignore[override]
        """Where the sensor of that scan was, in the body frame, shape (3,), m; None: at the body's origin."""
        return self._read().viewpoint if self._there[3] else None  # type: ignore[attr-defined]


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


class _StoredObservations(Sequence[Observation]):
    """The measurements of a keyframe."""

    __slots__ = ("_read", "_size")

    def __init__(self, read: Read, size: int) -> None:
        self._read, self._size = read, size

    def __len__(self) -> int:
        return self._size

    @overload
    def __getitem__(self, item: int) -> Observation: ...
    @overload
    def __getitem__(self, item: slice) -> Sequence[Observation]: ...
    def __getitem__(self, item: int | slice) -> Observation | Sequence[Observation]:
        return self._read().observations[item]

    def __iter__(self) -> Iterator[Observation]:
        return iter(self._read().observations)
