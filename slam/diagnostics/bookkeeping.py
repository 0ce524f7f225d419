"""Bookkeeping of a run: recording, consistency and open directions, in the one place that listens to the steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from factors.association.gating import hypotheses_of
from slam.backend.estimator import Backend
from slam.config import SlamConfig
from slam.diagnostics.consistency import NisAudit
from slam.diagnostics.observability import Observability
from slam.frontend.keyframes import Keyframe
from slam.frontend.observations import Observation
from slam.map.data_association import Decision
from slam.map.landmarks import LandmarkMap
from slam.mapping.map_update import LateMatch
from slam.session.recorder import Recorder
from slam.tracking.prediction import Prediction
from spplanes._check import FloatArray


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
        if not prediction.planes_asked:
            self.audit.add(prediction.index, [one.kind for one in seen], decisions)
            return
        for number, chi2, dof in innovations_without_prediction(
            seen, decisions, prediction.pose_key, self._landmarks, self._backend
        ):
            self.audit.count(prediction.index, seen[number].kind, chi2, dof)


#: A motion of the pose that moves no measurement by more than this many of its sigmas a metre or radian is not found.
_SILENT = 1e-2


def innovations_without_prediction(
    observations: Sequence[Observation],
    decisions: Sequence[Decision],
    pose_key: int,
    landmarks: LandmarkMap,
    backend: Backend,
) -> list[tuple[int, float, int]]:
    """(index of the observation, chi2, degrees of freedom) of every match, without what was known of the pose before.

    Where no odometry is, the pose of a keyframe is found by its planes: a prediction made of them agrees with them, and
    a wide one with anything. So the pose is taken as unknown. What the matches say beyond finding it has to agree
    within the covariance of measurements and map, which is chi2 with six degrees of freedom less where they fix
    everything. An observation has the share that it adds to those firmer than it. To be asked before the keyframe's
    factors are in the graph.
    """
    found = [(one.observation, one.match.landmark) for one in decisions if one.match is not None]
    found.sort(key=lambda pair: (-observations[pair[0]].n_points, pair[0]))
    if not found:
        return []
    keys = sorted({pose_key, *(key for _, i in found for key in (landmarks[i].key, landmarks[i].anchor_key))})
    joint, values = backend.joint_covariance(keys), backend.values_of(keys)
    rows, residuals = [], []
    for index, landmark in found:
        [hypothesis] = hypotheses_of(observations[index], [landmarks[landmark]], pose_key, joint, values, backend)
        rows.append(np.zeros((len(hypothesis.target), len(joint.full))))
        rows[-1][:, hypothesis.columns] = hypothesis.jacobian
        residuals.append(hypothesis.target)
    residual, by_pose = _whitened(np.vstack(rows), np.concatenate(residuals), joint.full, joint.columns([pose_key]))
    ends = np.cumsum([0, *map(len, residuals)]).tolist()
    left = [_left_over(residual[:end], by_pose[:end]) for end in ends]
    shares = zip(found, left[1:], left[:-1], strict=True)
    return [(index, max(chi2 - before, 0.0), dof - used) for (index, _), (chi2, dof), (before, used) in shares]


def _whitened(
    jacobian: FloatArray, residual: FloatArray, covariance: FloatArray, of_pose: np.ndarray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (n,) and their derivative by the pose (n, 6), in units of what measurements and map let them be.

    A row depends on no residual after its own.
    """
    by_map = jacobian.copy()
    by_map[:, of_pose] = 0.0
    root = np.linalg.cholesky(by_map @ covariance @ by_map.T + np.eye(len(residual)))
    both: FloatArray = np.asarray(np.linalg.solve(root, np.column_stack((residual, jacobian[:, of_pose]))), float)
    return both[:, 0], both[:, 1:]


def _left_over(residual: FloatArray, by_pose: FloatArray) -> tuple[float, int]:
    """What no pose explains of whitened residuals (n,) that depend on it by (n, 6): chi2 and degrees of freedom."""
    axes, sizes, _ = np.linalg.svd(by_pose, full_matrices=False)
    explained = axes[:, sizes > _SILENT].T @ residual
    return float(residual @ residual - explained @ explained), len(residual) - len(explained)
