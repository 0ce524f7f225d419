"""Bookkeeping of a run: what every step made of a keyframe is recorded, counted, and explained in words."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from slam.backend.estimator import Backend
from slam.config import SlamConfig
from slam.diagnostics.consistency import NisAudit, innovations_without_prediction
from slam.diagnostics.observability import Observability
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import Observation
from slam.loop_closure.closing import ClosedLoop
from slam.loop_closure.verification import LoopDecision
from slam.map.data_association import Candidate, Decision
from slam.map.landmarks import LandmarkMap
from slam.mapping.fusion import Merge
from slam.mapping.map_update import LateMatch
from slam.session.replay import Recorder
from slam.tracking.prediction import Prediction

#: Candidates named in a sentence.
_NAMED = 3


class Bookkeeping:
    """Is told what every step made of a keyframe; the steps know nothing of it."""

    def __init__(self, config: SlamConfig, recorder: Recorder, landmarks: LandmarkMap, backend: Backend) -> None:
        self.audit = NisAudit()
        self.observability = Observability(config.observability)
        self.late_matches: list[LateMatch] = []
        self._recorder, self._landmarks, self._backend = recorder, landmarks, backend

    def measured(self, index: int, keyframe: Keyframe) -> Keyframe:
        """A keyframe has come; the measurements to work with, which are on the disk if there is a session."""
        return self._recorder.measured(index, keyframe)

    def matched(self, keyframe: Keyframe, prediction: Prediction, decisions: Sequence[Decision]) -> None:
        """Its observations have been told apart; the graph does not know yet."""
        self._count_innovations(keyframe, prediction, decisions)
        self._recorder.decided(prediction.index, decisions)
        pairs = [
            (keyframe.observations[decision.observation], decision.match)
            for decision in decisions
            if decision.match is not None
        ]
        normals = [self._landmarks.placed(match.landmark).normal for _, match in pairs]
        pose = self._backend.pose(prediction.pose_key)
        self.observability.add(prediction.index, [seen for seen, _ in pairs], pose, prediction.motion, normals)

    def matched_late(self, late: Sequence[LateMatch]) -> None:
        """Observations of earlier keyframes have been matched to its landmarks."""
        self.late_matches += late

    def _count_innovations(self, keyframe: Keyframe, prediction: Prediction, decisions: Sequence[Decision]) -> None:
        """Hold what was matched against what was known: without odometry nothing of the pose."""
        seen = keyframe.observations
        if prediction.hints:  # what says where to look was made of what was seen here
            return
        if not prediction.planes_asked:
            self.audit.add(prediction.index, [one.kind for one in seen], decisions)
            return
        for number, chi2, dof in innovations_without_prediction(
            seen, decisions, prediction.pose_key, self._landmarks, self._backend
        ):
            self.audit.count(prediction.index, seen[number].kind, chi2, dof)


def decision_sentence(decision: Decision, observation: Observation) -> str:
    """What became of an observation, and what it was compared with, likeliest first."""
    what = f"{observation.kind} {decision.observation} ({observation.n_points} points)"
    compared = ", ".join(_candidate(candidate) for candidate in decision.candidates[:_NAMED]) or "no landmark near"
    if decision.match is not None:
        return f"{what} is landmark {decision.match.landmark}: {compared}"
    if decision.verdict == "new":
        return f"{what} is none of the landmarks: {compared}"
    return f"{what} is not used, it may be one and may be none: {compared}"


def change_sentences(
    keyframe: int, merges: Iterable[Merge], loops: Sequence[LoopDecision], closed: Iterable[ClosedLoop]
) -> list[str]:
    """What a keyframe changed in the map: merges, merges taken back, loops looked for, loops taken back."""
    sentences = []
    for merge in merges:
        if merge.keyframe == keyframe:
            sentences.append(f"landmark {merge.younger} became part of landmark {merge.older} ({merge.cause})")
        if merge.undone == keyframe:
            sentences.append(f"landmark {merge.younger} was found not to be landmark {merge.older} after all")
    for loop in loops:
        if loop.keyframe == keyframe:
            sentences.append(f"compared with the surroundings of keyframe {loop.old_keyframe}: {loop.verdict}")
    for known in closed:
        if known.undone == keyframe:
            ends = known.loop.keyframe, known.loop.old_keyframe
            sentences.append("keyframe {} was found not to have come back to the place of keyframe {}".format(*ends))
    return sentences


def _candidate(one: Candidate) -> str:
    return f"landmark {one.landmark} chi2 {one.chi2:.1f} of {one.dof} dof (p {one.p_value:.2g})"
