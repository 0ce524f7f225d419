"""Bookkeeping of a run: recording, consistency and open directions, in the one place that listens to the steps."""

from __future__ import annotations

from collections.abc import Sequence

from slam.association.data_association import Decision
from slam.backend.estimator import Backend
from slam.config import SlamConfig
from slam.diagnostics.consistency import NisAudit
from slam.diagnostics.observability import Observability
from slam.diagnostics.pose_free_innovations import innovations_without_prediction
from slam.frontend.keyframes import Keyframe
from slam.map.landmarks import LandmarkMap
from slam.mapping.late_association import LateMatch
from slam.session.recorder import Recorder
from slam.tracking.prediction import Prediction


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
        pairs = [(keyframe.observations[one.observation], one.match) for one in decisions if one.match is not None]
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
        if not prediction.is_wide:
            self.audit.add(prediction.index, [one.kind for one in seen], decisions)
            return
        for number, chi2, dof in innovations_without_prediction(
            seen, decisions, prediction.pose_key, self._landmarks, self._backend
        ):
            self.audit.count(prediction.index, seen[number].kind, chi2, dof)
