"""Recorder: what a run tells about itself while it runs; nothing, unless somebody listens."""

from __future__ import annotations

from collections.abc import Mapping, MutableSequence, Sequence

from slam.frontend.keyframes import Keyframe
from slam.frontend.pose_measurements import PlaceMatch
from slam.map.data_association import Decision

#: Places by the keyframe that stands near them.
Places = Mapping[int, Sequence[PlaceMatch]]


class Recorder:
    """Listens to a `PlaneSlam`: here to nothing; a session on disk is a `slam.session.store.SessionRecorder`.

    Whatever these methods raise ends `add_keyframe` before the graph has used what they were told.
    """

    def keyframes(self) -> MutableSequence[Keyframe]:
        """Where the estimator keeps its keyframes: in memory."""
        return []

    def decisions(self) -> MutableSequence[list[Decision]]:
        """Where the estimator keeps its decisions: in memory."""
        return []

    def measured(self, index: int, keyframe: Keyframe) -> Keyframe:
        """The measurements of a keyframe, before anything is done with them; returns those to work with."""
        return keyframe

    def decided(self, index: int, decisions: Sequence[Decision]) -> None:
        """What each of them was taken for, before its factor is added."""

    def mended(self, places: Places, decisions: Sequence[Sequence[Decision]]) -> None:
        """All keyframes were matched anew with more places known: these decisions take the place of those before."""

    def close(self) -> None:
        """Nothing more will come."""


class SecondPass(Recorder):
    """Listens to keyframes that another recorder has, as they are matched anew; of those that follow it tells that one.

    Args:
        first: the recorder.
        count: keyframes that it has.
    """

    def __init__(self, first: Recorder, count: int) -> None:
        self._first, self._count = first, count

    def measured(self, index: int, keyframe: Keyframe) -> Keyframe:
        """Those that are known stay as they are."""
        return keyframe if index < self._count else self._first.measured(index, keyframe)

    def decided(self, index: int, decisions: Sequence[Decision]) -> None:
        """Nothing is kept before the first recorder is told that all of it counts."""
        if index >= self._count:
            self._first.decided(index, decisions)
