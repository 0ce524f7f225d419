"""Map update: what a keyframe saw goes into the graph, late where its landmark came later, and landmarks grow by it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from factors import plane_factor, plane_landmark
from factors.association.estimate import observation_factor
from factors.association.grouping import group_planes
from slam.backend.estimator import Backend, pose_symbol
from slam.config import AssociationConfig, LandmarkConfig, SlamConfig
from slam.frontend.information import information_beyond_lines
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import LineObservation, Observation, PlaneObservation
from slam.geometry.frames import inverse
from slam.map.data_association import Associate, Decision, gates_of
from slam.map.landmarks import Landmark, LandmarkMap, Sighting
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
    return (is_large(plane, rules) and tilt <= rules.max_tilt_sigma_rad) or _is_firm(plane, tilt, rules)


def _is_firm(plane: Plane, tilt: float, rules: LandmarkConfig) -> bool:
    """Whether a patch too small to start a landmark is too sure to be the edge of something: the front of a lamp."""
    return (
        plane.n_points >= FIRM_POINTS
        and tilt <= FIRM_TILT * rules.max_tilt_sigma_rad
        and plane.outline is not None
        and plane.outline.area >= FIRM_AREA * rules.min_area_m2
    )


def is_large(plane: Plane, rules: LandmarkConfig) -> bool:
    """Whether a patch is large enough to be more than the edge of something."""
    return plane.n_points >= rules.min_points and (plane.outline is None or plane.outline.area >= rules.min_area_m2)


def group_new(
    observations: Sequence[Observation], rules: LandmarkConfig, association: AssociationConfig
) -> list[list[int]]:
    """Gather measurements of one keyframe that are one plane; the first of each group, the firmest, starts it.

    Measurements that may not start a landmark join a group but do not make one.

    Returns:
        Groups of indices into `observations`, in order of their first member.
    """
    firm = [may_start(observation, rules) for observation in observations]
    return group_planes(observations, gates_of(association), rules.wall_tilt_sigma_rad, firm)


@dataclass(frozen=True, eq=False)
class Insertion:
    """An observation on its way into the graph."""

    landmark: Landmark
    """What it is of."""
    observation: Observation
    """The measurement."""
    number: int
    """Its index in the keyframe."""
    factor: Any
    """Its factor."""
    plane_T_body: FloatArray
    """The keyframe's body in the landmark's plane frame, shape (4, 4)."""


def insert_matches(
    observations: Sequence[Observation],
    pose_key: int,
    decisions: Sequence[Decision],
    landmarks: LandmarkMap,
    backend: Backend,
    robust: str | None,
) -> list[Insertion]:
    """Factors of the observations that were matched to a landmark, with a robust kernel or without."""
    insertions = []
    for decision in decisions:
        if decision.match is None:
            continue
        observation = observations[decision.observation]
        landmark = landmarks[decision.match.landmark]
        factor = observation_factor(observation, pose_key, landmark, backend, robust)
        plane_T_body = inverse(landmarks.placed(landmark.id).world_T_plane) @ backend.pose(pose_key)
        insertions.append(Insertion(landmark, observation, decision.observation, factor, plane_T_body))
    return insertions


def initialize_landmarks(
    seen: Sequence[Observation],
    pose_keys: tuple[int, int],
    decisions: Sequence[Decision],
    landmarks: LandmarkMap,
    backend: Backend,
    config: SlamConfig,
    initial: gtsam.Values,
) -> list[Insertion]:
    """Landmarks of what no landmark explains, each with every observation of this keyframe that is its plane.

    Args:
        seen: the keyframe's observations.
        pose_keys: of the anchor and of the keyframe. The anchor is a pose before: of its own pose, a landmark's first
            factor would be custom, thus slow.
        decisions: one an observation.
        landmarks: where they are born.
        backend, config: the state, the rules.
        initial: takes the estimates of the new variables.
    """
    numbers = [decision.observation for decision in decisions if decision.verdict == "new"]
    observations = [seen[number] for number in numbers]
    anchor_key, pose_key = pose_keys
    anchor_T_body = inverse(backend.pose(anchor_key)) @ backend.pose(pose_key)
    insertions = []
    for group in group_new(observations, config.landmarks, config.association):
        plane = observations[group[0]].full_plane(config.landmarks.wall_tilt_sigma_rad)
        anchored = plane.transform(anchor_T_body)
        plane_T_body = inverse(anchored.frame) @ anchor_T_body
        landmark = landmarks.birth(observations[group[0]], anchor_key, anchored.frame, plane_T_body)
        initial.insert(landmark.key, plane_landmark(anchored))
        factor = plane_factor(plane, pose_key, landmark.key, anchor_key=anchor_key)
        insertions.append(Insertion(landmark, observations[group[0]], numbers[group[0]], factor, plane_T_body))
        for member in group[1:]:
            observation, robust = observations[member], config.backend.robust
            factor = observation.factor(pose_key, landmark.key, anchor_key, robust, plane_landmark(plane))
            insertions.append(Insertion(landmark, observation, numbers[member], factor, plane_T_body))
    return insertions


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

    def __init__(self, state: EstimatorState, associate: Associate) -> None:
        self._keyframes, self._landmarks, self._backend = state.keyframes, state.landmarks, state.backend
        self._sparsifier, self._config, self._associate = state.sparsifier, state.config, associate
        self._unmatched = Waiting(state.config.landmarks)

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
        indices = self._backend.update(factors, initial, remove=leaving, relinearize=prediction.planes_asked)
        turn = inverse(expected)[:3, :3] @ self._backend.pose(pose_key)[:3, :3]
        if not prediction.planes_asked and bends(turn, [insertion.observation for insertion in insertions]):
            self._backend.relinearize_in_use()
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
        beyond = information_beyond_lines(motion, matched)
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
