"""Late association: patches too uncertain to start a landmark are matched once it is there."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from slam.association.data_association import Associate, Decision
from slam.backend.estimator import Backend, pose_symbol
from slam.config import AssociationConfig, LandmarkConfig
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import PlaneObservation
from slam.map.landmarks import LandmarkMap
from slam.mapping.initialization import is_large


@dataclass(frozen=True)
class LateMatch:
    """An observation that was matched after its own keyframe."""

    at: int
    """Keyframe after which it was matched: that of the landmark's birth."""
    keyframe: int
    """Keyframe that saw it."""
    decision: Decision
    """Its match, judged by the state at the time of the match."""


@dataclass(eq=False)
class Waiting:
    """Planes of the last few keyframes that were no landmark's, large enough to start one but too uncertain in tilt.

    Only planes wait: a 2D laser sees its walls again in the next scan, a 3D scan may be the only one from its place.
    """

    rules: LandmarkConfig
    """How many keyframes an observation waits, and what is large enough."""
    _numbers: dict[int, list[int]] = field(default_factory=dict)

    def add(self, index: int, keyframe: Keyframe, numbers: Iterable[int]) -> None:
        """Let observations (`numbers`) of keyframe `index` wait; forget those that have waited long enough."""
        seen = keyframe.observations
        planes = [
            number
            for number in numbers
            if isinstance(seen[number], PlaneObservation) and is_large(seen[number].full_plane(0.0), self.rules)
        ]
        if planes:
            self._numbers[index] = planes
        for old in [old for old in self._numbers if old <= index - self.rules.waiting_keyframes]:
            del self._numbers[old]

    def match(
        self,
        born: set[int],
        at: int,
        keyframes: Sequence[Keyframe],
        landmarks: LandmarkMap,
        backend: Backend,
        config: AssociationConfig,
        associate: Associate,
    ) -> list[LateMatch]:
        """Matches of what waits in earlier keyframes with landmarks just born; what is matched waits no longer.

        Args:
            born: ids of the new landmarks.
            at: the keyframe that they are of.
            keyframes: all so far.
            landmarks, backend, config, associate: the state, the gates of association, and association itself.
        """
        found = []
        for index in sorted(old for old in self._numbers if old < at and born):
            numbers = self._numbers[index]
            seen = [keyframes[index].observations[number] for number in numbers]
            decisions = associate(seen, pose_symbol(index), landmarks, backend, config, among=born)
            for number, decision in zip(numbers, decisions, strict=True):
                if decision.match is not None:
                    own = Decision(number, "match", decision.match, decision.candidates)
                    found.append(LateMatch(at, index, own))
            taken = {late.decision.observation for late in found if late.keyframe == index}
            self._numbers[index] = [number for number in numbers if number not in taken]
        return found
