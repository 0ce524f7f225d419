"""Map update: what a keyframe saw goes into the graph, late where its landmark came later, and landmarks grow by it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from slam.backend.estimator import Backend, pose_symbol
from slam.config import AssociationConfig, LandmarkConfig
from slam.frontend.information import beyond_lines
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import Observation, PlaneObservation
from slam.geometry.frames import inverse
from slam.map.data_association import Associate, Decision
from slam.map.landmarks import LandmarkMap, Sighting
from slam.map.state import Parts
from slam.mapping.insertion import Insertion, initialize_landmarks, insert_matches, is_large
from slam.tracking.prediction import Prediction
from spplanes._check import FloatArray


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


@dataclass(frozen=True)
class MapUpdate:
    """What a keyframe changed in the map."""

    keyframe: int
    """Its index."""
    touched: frozenset[int] = frozenset()
    """Ids of the landmarks that it saw, new ones among them."""


class MapUpdater:
    """Puts observations into the graph and lets the map know."""

    def __init__(self, parts: Parts, associate: Associate) -> None:
        self._keyframes, self._landmarks, self._backend = parts.keyframes, parts.landmarks, parts.backend
        self._sparsifier, self._config, self._associate = parts.sparsifier, parts.config, associate
        self._unmatched = Waiting(parts.config.landmarks)

    def update(self, keyframe: Keyframe, prediction: Prediction, decisions: Sequence[Decision]) -> MapUpdate:
        """Add the factors of matches and of new landmarks, then count what was seen."""
        seen, initial = keyframe.observations, gtsam.Values()
        at, pose_key = prediction.index, prediction.pose_key
        insertions = insert_matches(seen, pose_key, decisions, self._landmarks, self._backend, prediction.robust)
        anchor = self._sparsifier.anchor(at, self._config.landmarks.anchor_every)
        keys = pose_symbol(anchor), pose_key
        births = initialize_landmarks(seen, keys, decisions, self._landmarks, self._backend, self._config, initial)
        if births:
            self._sparsifier.stays(anchor)
        matched = [insertion.observation for insertion in insertions]
        leaves = self._sparsifier.judge(
            at, matched, [insertion.factor for insertion in insertions], may_leave=not births
        )
        beyond = self._beyond_lines(prediction, matched)
        insertions += births
        used = {insertion.number for insertion in insertions}
        unused = [] if leaves else [i for i in range(len(seen)) if i not in used]
        self._unmatched.add(at, keyframe, unused)
        factors = [*(insertion.factor for insertion in insertions), *prediction.pending, *beyond]
        if not factors:
            if prediction.hints:
                self._backend.update([], initial, remove=prediction.hints)
            return MapUpdate(at)
        leaving, expected = [*prediction.standing_in, *prediction.hints], self._backend.pose(pose_key)
        indices = self._backend.update(factors, initial, remove=leaving, relinearize=prediction.is_wide)
        turn = inverse(expected)[:3, :3] @ self._backend.pose(pose_key)[:3, :3]
        if not prediction.is_wide and bends(turn, [insertion.observation for insertion in insertions]):
            self._backend.settle(1)
        for insertion, factor_index in zip(insertions, indices, strict=False):
            self._see(insertion, at, factor_index, prediction.robust)
        if beyond:
            self._sparsifier.linked(at, indices[-1])
        return MapUpdate(at, frozenset(insertion.landmark.id for insertion in insertions))

    def _beyond_lines(self, prediction: Prediction, matched: Sequence[Observation]) -> list[Any]:
        """The factor of what the returns say of the motion beyond what was matched, if they do."""
        motion = prediction.motion
        if motion is None or prediction.place is not None:
            return []
        beyond = beyond_lines(motion, matched)
        return [] if beyond is None else beyond.factors(pose_symbol(prediction.index - 1), prediction.pose_key)[:1]

    def match_late(self, update: MapUpdate) -> list[LateMatch]:
        """Match what earlier keyframes saw of the landmarks that this one started."""
        at = update.keyframe
        born = {number for number in update.touched if self._landmarks[number].first_keyframe == at}
        late = self._unmatched.match(
            born, at, self._keyframes, self._landmarks, self._backend, self._config.association, self._associate
        )
        for match in late:
            observations = self._keyframes[match.keyframe].observations
            [insertion] = insert_matches(
                observations,
                pose_symbol(match.keyframe),
                [match.decision],
                self._landmarks,
                self._backend,
                self._config.backend.robust,
            )
            [factor_index] = self._backend.update([insertion.factor], gtsam.Values(), relinearize=True)
            self._see(insertion, match.keyframe, factor_index, self._config.backend.robust)
        if late:
            self._landmarks.refresh(self._backend)
        return late

    def _see(self, insertion: Insertion, keyframe: int, factor_index: int, robust: str | None) -> None:
        """Let a landmark know what a keyframe saw of it, now that it is in the graph."""
        sighting = Sighting(keyframe, insertion.number, factor_index, insertion.observation.kind, robust)
        self._landmarks.see(insertion.landmark, insertion.observation, sighting, insertion.plane_T_body)


def bends(turn: FloatArray, seen: Sequence[Observation]) -> bool:
    """Whether a pose was turned, by a rotation (3, 3), so far that linear factors of what it saw are wrong by a sigma.

    To second order a point at distance r from the body is off by r angle^2 / 2. Where that says nothing, iSAM2's own
    relinearisation when the next keyframe comes is soon enough; at every keyframe it took a tenth of the time of Intel.
    """
    square = max(3.0 - float(np.trace(turn)), 0.0)  # of the angle, to second order
    return any(0.5 * square * float(np.linalg.norm(one.vertices.mean(axis=0))) > one.sigma_m for one in seen)
