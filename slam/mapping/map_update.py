"""What a keyframe saw goes into the graph, and landmarks grow by it: matches, births, what was seen too early."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam

from slam.association.data_association import Decision
from slam.backend.estimator import pose_symbol
from slam.frontend.keyframes import Keyframe
from slam.map.landmarks import Sighting
from slam.map.state import Parts
from slam.mapping.insertion import Sight, birth_sights, matched_sights
from slam.mapping.late_association import LateMatch, Waiting
from slam.tracking.prediction import Prediction


class Growth:
    """Puts observations into the graph and lets the map know."""

    def __init__(self, parts: Parts, prediction: Prediction) -> None:
        self._keyframes, self._landmarks, self._backend = parts.keyframes, parts.landmarks, parts.backend
        self._thinning, self._prediction, self._config = parts.thinning, prediction, parts.config
        self._unmatched = Waiting(parts.config.landmarks)
        self.late_matches: list[LateMatch] = []

    def update(self, keyframe: Keyframe, pose_key: int, decisions: Sequence[Decision]) -> set[int]:
        """Add the factors of matches and of new landmarks, then count what was seen; the ids of those landmarks."""
        seen, initial = keyframe.observations, gtsam.Values()
        at = len(self._keyframes)
        sights = matched_sights(seen, pose_key, decisions, self._landmarks, self._backend, self._prediction.robust)
        anchor = self._thinning.anchor(at, self._config.landmarks.anchor_every)
        keys = pose_symbol(anchor), pose_key
        births = birth_sights(seen, keys, decisions, self._landmarks, self._backend, self._config, initial)
        if births:
            self._thinning.stays(anchor)
        matched = [sight.observation for sight in sights]
        leaves = self._thinning.judge(at, matched, [sight.factor for sight in sights], may_leave=not births)
        sights += births
        used = {sight.number for sight in sights}
        unused = [] if leaves else [i for i in range(len(seen)) if i not in used]
        self._unmatched.add(at, keyframe, unused)
        factors = [*(sight.factor for sight in sights), *self._prediction.waiting]
        if not factors:
            return set()
        indices = self._backend.update(factors, initial, remove=self._prediction.standing_in, relinearize=True)
        self._prediction.confirmed()
        for sight, factor_index in zip(sights, indices, strict=False):
            self._see(sight, at, factor_index)
        return {sight.landmark.id for sight in sights}

    def match_late(self, touched: set[int]) -> None:
        """Match what earlier keyframes saw of the landmarks that this one started."""
        at = len(self._keyframes) - 1
        born = {number for number in touched if self._landmarks[number].first_keyframe == at}
        late = self._unmatched.match(
            born, at, self._keyframes, self._landmarks, self._backend, self._config.association
        )
        for match in late:
            observations = self._keyframes[match.keyframe].observations
            [sight] = matched_sights(
                observations,
                pose_symbol(match.keyframe),
                [match.decision],
                self._landmarks,
                self._backend,
                self._config.backend.robust,
            )
            [factor_index] = self._backend.update([sight.factor], gtsam.Values(), relinearize=True)
            self._see(sight, match.keyframe, factor_index)
        if late:
            self._landmarks.refresh(self._backend)
        self.late_matches += late

    def _see(self, sight: Sight, keyframe: int, factor_index: int) -> None:
        """Let a landmark know what a keyframe saw of it, now that it is in the graph."""
        sighting = Sighting(keyframe, sight.number, factor_index, sight.observation.kind)
        self._landmarks.see(sight.landmark, sight.observation, sighting, sight.plane_T_body)
