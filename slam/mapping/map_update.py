"""Map update: what a keyframe saw goes into the graph, and landmarks grow by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from slam.association.data_association import Associate, Decision
from slam.backend.estimator import pose_symbol
from slam.frontend.information import beyond_lines
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import Observation
from slam.geometry.frames import inverse
from slam.map.landmarks import Sighting
from slam.map.state import Parts
from slam.mapping.insertion import Insertion, initialize_landmarks, insert_matches
from slam.mapping.late_association import LateMatch, Waiting
from slam.tracking.prediction import Prediction
from spplanes._check import FloatArray


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
