"""Map update: what a keyframe saw goes into the graph, late where its landmark came later, and landmarks grow by it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from factors import plane_factor, plane_landmark
from factors.association.estimate import observation_factor
from factors.association.grouping import group_planes
from factors.association.observations import LineObservation, Observation, PlaneObservation
from slam.backend.estimator import pose_symbol
from slam.config import LandmarkConfig
from slam.frontend.information import information_beyond_lines
from slam.frontend.keyframes import Keyframe
from slam.geometry.frames import inverse
from slam.map.data_association import Associate, Decision
from slam.map.landmarks import Landmark, Sighting
from slam.map.state import EstimatorState
from slam.tracking.prediction import Prediction
from spplanes import Plane
from spplanes._check import FloatArray

#: A plane of so many points whose tilt is known to this share of what is asked starts a landmark though it has only
#: this share of the area asked: a push-broom window sees half a metre of anything.
FIRM_POINTS, FIRM_TILT, FIRM_AREA = 200, 0.2, 0.5


def may_start(observation: Observation, rules: LandmarkConfig) -> bool:
    """Whether a measurement is firm enough to start a landmark."""
    if isinstance(observation, LineObservation):
        ends = observation.vertices
        long_enough = float(np.linalg.norm(ends[1] - ends[0])) >= rules.min_line_length_m
        return long_enough and observation.n_points >= rules.min_line_points
    plane = observation.full_plane(0.0)
    tilt = float(np.sqrt(np.linalg.eigvalsh(plane.covariance[1:, 1:])[-1]))
    if is_large(plane, rules) and tilt <= rules.max_tilt_sigma_rad:
        return True
    # a patch so sure is the edge of nothing: the front of a lamp
    firm = plane.n_points >= FIRM_POINTS and tilt <= FIRM_TILT * rules.max_tilt_sigma_rad
    return firm and plane.outline is not None and plane.outline.area >= FIRM_AREA * rules.min_area_m2


def is_large(plane: Plane, rules: LandmarkConfig) -> bool:
    """Whether a patch is large enough to be more than the edge of something."""
    return plane.n_points >= rules.min_points and (plane.outline is None or plane.outline.area >= rules.min_area_m2)


@dataclass(frozen=True, eq=False)
class Insertion:
    """An observation on its way into the graph."""

    landmark: Landmark
    observation: Observation
    number: int
    """Of the observation in the keyframe."""
    factor: Any
    plane_T_body: FloatArray
    """The keyframe's body in the landmark's plane frame, shape (4, 4)."""


@dataclass(frozen=True)
class LateMatch:
    """An observation that was matched after its own keyframe."""

    at: int
    """Keyframe after which it was matched: that of the landmark's birth."""
    keyframe: int
    """Keyframe that saw it."""
    decision: Decision
    """Its match, judged by the state at the time of the match."""


class MapUpdater:
    """Puts observations into the graph and lets the map know."""

    def __init__(self, state: EstimatorState, associate: Associate) -> None:
        self._keyframes, self._landmarks, self._backend = state.keyframes, state.landmarks, state.backend
        self._sparsifier, self._config, self._associate = state.sparsifier, state.config, associate
        #: By keyframe, of the last few, planes that were no landmark's, large enough to start one but too uncertain in
        #: tilt. Only planes wait: a 2D laser sees its walls again in the next scan, a 3D scan may be the only one from
        #: its place.
        self._waiting: dict[int, list[int]] = {}

    def update(self, keyframe: Keyframe, prediction: Prediction, decisions: Sequence[Decision]) -> set[int]:
        """Add the factors of matches and of new landmarks, then count what was seen; ids of the landmarks touched."""
        seen, initial = keyframe.observations, gtsam.Values()
        at, pose_key = prediction.index, prediction.pose_key
        insertions = [
            self._match(seen[decision.observation], pose_key, decision, prediction.robust)
            for decision in decisions
            if decision.match is not None
        ]
        anchor = self._sparsifier.anchor(at, self._config.landmarks.anchor_every, prediction.since)
        numbers = [decision.observation for decision in decisions if decision.verdict == "new"]
        births = self._births(seen, numbers, pose_symbol(anchor), pose_key, initial)
        if births:
            self._sparsifier.stays(anchor)
        matched = [insertion.observation for insertion in insertions]
        factors = [insertion.factor for insertion in insertions]
        leaves = self._sparsifier.judge(at, matched, factors, may_leave=not births)
        insertions += births
        used = {insertion.number for insertion in insertions}
        self._let_wait(at, seen, [] if leaves else [i for i in range(len(seen)) if i not in used], prediction.since)
        factors = [*(one.factor for one in insertions), *prediction.pending, *self._beyond_lines(prediction, matched)]
        if not factors:
            if prediction.hints:
                self._backend.update([], initial, remove=prediction.hints)
            return set()
        leaving, expected = [*prediction.standing_in, *prediction.hints], self._backend.pose(pose_key)
        indices = self._backend.update(factors, initial, remove=leaving, relinearize=prediction.planes_asked)
        turn = inverse(expected)[:3, :3] @ self._backend.pose(pose_key)[:3, :3]
        if not prediction.planes_asked and bends(turn, [insertion.observation for insertion in insertions]):
            self._backend.relinearize_in_use()
        for insertion, factor_index in zip(insertions, indices, strict=False):
            self._see(insertion, at, factor_index, prediction.robust)
        for factor_index in indices[len(insertions) :]:
            self._sparsifier.linked(at, factor_index)
        return {insertion.landmark.id for insertion in insertions}

    def _beyond_lines(self, prediction: Prediction, matched: Sequence[Observation]) -> list[Any]:
        """The factor of what the returns say of the motion beyond what was matched, if they do."""
        motion = prediction.motion
        if motion is None or prediction.place is not None:
            return []
        beyond = information_beyond_lines(motion, matched)
        return [] if beyond is None else [beyond.factor(pose_symbol(prediction.index - 1), prediction.pose_key)]

    def match_late(self, at: int, touched: Iterable[int]) -> list[LateMatch]:
        """Match what earlier keyframes saw of those landmarks, of all that a keyframe touched, that it started."""
        born = {number for number in touched if self._landmarks[number].first_keyframe == at}
        late, robust = self._matches_of_waiting(born, at), self._config.backend.robust
        for one in late:
            seen = self._keyframes[one.keyframe].observations[one.decision.observation]
            insertion = self._match(seen, pose_symbol(one.keyframe), one.decision, robust)
            [factor_index] = self._backend.update([insertion.factor], gtsam.Values(), relinearize=True)
            self._see(insertion, one.keyframe, factor_index, robust)
        if late:
            self._landmarks.refresh(self._backend)
        return late

    def _match(self, seen: Observation, pose_key: int, decision: Decision, robust: str | None) -> Insertion:
        """An observation with its factor on the landmark it was matched to, with a robust kernel or without."""
        assert decision.match is not None
        landmark = self._landmarks[decision.match.landmark]
        factor = observation_factor(seen, pose_key, landmark, self._backend, robust)
        plane_T_body = inverse(self._landmarks.placed(landmark.id).world_T_plane) @ self._backend.pose(pose_key)
        return Insertion(landmark, seen, decision.observation, factor, plane_T_body)

    def _births(
        self, seen: Sequence[Observation], numbers: Sequence[int], anchor_key: int, pose_key: int, initial: gtsam.Values
    ) -> list[Insertion]:
        """Landmarks of observations (`numbers`) that no landmark explains, each with all of these that are its plane.

        The first of each group, the firmest, starts it; what may start none joins one or is left. The anchor is a pose
        before: of its own pose, a landmark's first factor would be custom, thus slow. `initial` takes the estimates of
        the new variables.
        """
        rules, robust, observations = self._config.landmarks, self._config.backend.robust, [seen[k] for k in numbers]
        firm = [may_start(observation, rules) for observation in observations]
        anchor_T_body = inverse(self._backend.pose(anchor_key)) @ self._backend.pose(pose_key)
        insertions = []
        for group in group_planes(observations, self._config.association, rules.wall_tilt_sigma_rad, firm):
            first = observations[group[0]]
            plane = first.full_plane(rules.wall_tilt_sigma_rad)
            anchored = plane.transform(anchor_T_body)
            plane_T_body = inverse(anchored.frame) @ anchor_T_body
            landmark = self._landmarks.birth(first, anchor_key, anchored.frame, plane_T_body)
            initial.insert(landmark.key, plane_landmark(anchored))
            factors = [plane_factor(plane, pose_key, landmark.key, anchor_key=anchor_key)]
            for member in group[1:]:
                expected = plane_landmark(plane)
                factors.append(observations[member].factor(pose_key, landmark.key, anchor_key, robust, expected))
            for member, factor in zip(group, factors, strict=True):
                insertions.append(Insertion(landmark, observations[member], numbers[member], factor, plane_T_body))
        return insertions

    def _let_wait(self, index: int, seen: Sequence[Observation], numbers: Iterable[int], since: int) -> None:
        """Let observations (`numbers`) of keyframe `index` wait; forget those that have waited long enough.

        And those of keyframes before `since`, the first of the stretch that it is in.
        """
        rules = self._config.landmarks
        planes = [
            number
            for number in numbers
            if isinstance(seen[number], PlaneObservation) and is_large(seen[number].full_plane(0.0), rules)
        ]
        if planes:
            self._waiting[index] = planes
        for old in [old for old in self._waiting if old < since or old <= index - rules.waiting_keyframes]:
            del self._waiting[old]

    def _matches_of_waiting(self, born: set[int], at: int) -> list[LateMatch]:
        """Matches of what waits in earlier keyframes with landmarks just born; what is matched waits no longer."""
        found = []
        for index in sorted(old for old in self._waiting if old < at and born):
            numbers, rules = self._waiting[index], self._config.association
            seen = [self._keyframes[index].observations[number] for number in numbers]
            decisions = self._associate(seen, pose_symbol(index), self._landmarks, self._backend, rules, among=born)
            own = [replace(decision, observation=number) for number, decision in zip(numbers, decisions, strict=True)]
            self._waiting[index] = [one.observation for one in own if one.match is None]
            found += [LateMatch(at, index, one) for one in own if one.match is not None]
        return found

    def _see(self, insertion: Insertion, keyframe: int, factor_index: int, robust: str | None) -> None:
        """Let a landmark know what a keyframe saw of it, now that it is in the graph."""
        seen = insertion.observation
        sensor = seen.sensor if isinstance(seen, PlaneObservation) and seen.calibration_effect is not None else None
        sighting = Sighting(keyframe, insertion.number, factor_index, seen.kind, robust, sensor)
        self._landmarks.see(insertion.landmark, seen, sighting, insertion.plane_T_body)


def bends(turn: FloatArray, seen: Sequence[Observation]) -> bool:
    """Whether a pose was turned, by a rotation (3, 3), so far that linear factors of what it saw are wrong by a sigma.

    To second order a point at distance r from the body is off by r angle^2 / 2. Where that says nothing, iSAM2's own
    relinearisation when the next keyframe comes is soon enough; at every keyframe it took a tenth of the time of Intel.
    """
    square = max(3.0 - float(np.trace(turn)), 0.0)  # of the angle, to second order
    return any(0.5 * square * float(np.linalg.norm(one.vertices.mean(axis=0))) > one.sigma_m for one in seen)
