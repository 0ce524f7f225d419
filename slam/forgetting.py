"""Keyframes whose measurements stay on the disk, so that memory does not grow with them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields
from functools import lru_cache, partial
from typing import overload

from slam.keyframes import Keyframe
from slam.observations import Observation
from slam.store import Session
from spplanes._check import FloatArray

#: Keyframes that stay in memory after they were read: the last few are looked at again and again.
_KEPT = 32

Read = Callable[[], Keyframe]


class ForgottenKeyframes(list[Keyframe]):
    """Keyframes that keep the time and the motion, not what was seen."""

    def __init__(self, session: Session) -> None:
        super().__init__()
        self._read = lru_cache(maxsize=_KEPT)(session.keyframe)

    def append(self, keyframe: Keyframe) -> None:
        """Add one whose measurements the session has."""
        super().append(StoredKeyframe(keyframe, partial(self._read, len(self))))


class StoredKeyframe(Keyframe):
    """A keyframe that was recorded: its observations and returns are read from the session when they are asked for."""

    def __init__(self, keyframe: Keyframe, read: Read) -> None:
        kept = {one.name: getattr(keyframe, one.name) for one in fields(Keyframe) if one.name != "returns"}
        seen = _StoredObservations(read, len(keyframe.observations))
        stored = {
            **kept,
            "observations": seen,
            "scans": (),
            "_read": read,
            "_has_returns": keyframe.returns is not None,
        }
        for name, value in stored.items():
            object.__setattr__(self, name, value)  # frozen: set once, here

    def __repr__(self) -> str:
        return f"StoredKeyframe(stamp_ns={self.stamp_ns})"  # without reading it

    @property
    def returns(self) -> FloatArray | None:  # type: ignore[override]  # a field there, read each time here
        """Beams that met a surface, rows (x0, y0, x1, y1), shape (N, 4), m; None: no such laser."""
        return self._read().returns if self._has_returns else None  # type: ignore[attr-defined]


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
