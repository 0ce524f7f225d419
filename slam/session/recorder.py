"""Recorder: what a run tells about itself while it runs; nothing, unless somebody listens."""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence

from slam.association.data_association import Decision
from slam.frontend.keyframes import Keyframe


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

    def close(self) -> None:
        """Nothing more will come."""
