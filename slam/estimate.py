"""What an estimator holds, and what can be read of it: trajectory, map, what nothing fixes, why it decided so."""

from __future__ import annotations

from collections.abc import MutableSequence
from typing import TYPE_CHECKING

import numpy as np

from slam.association.data_association import Decision
from slam.backend.estimator import Backend, pose_symbol
from slam.config import SlamConfig
from slam.diagnostics.consistency import NisAudit
from slam.diagnostics.explanations import change_sentences, decision_sentence
from slam.diagnostics.map_observability import OpenMapDirection, open_in_map
from slam.diagnostics.observability import Observability, OpenStretch, stretch_of
from slam.frontend.keyframes import Keyframe
from slam.frontend.wheel_calibration import WheelCalibration
from slam.io.trajectories import Trajectory
from slam.loop_closure.closing import LoopCloser
from slam.loop_closure.verification import LoopDecision
from slam.map.landmarks import LandmarkMap
from slam.map.map_planes import MapPlane, map_plane
from slam.map.sparsification import Thinning
from slam.map.state import Parts
from slam.mapping.fusion import Merges
from slam.mapping.late_association import LateMatch
from slam.mapping.map_update import Growth
from slam.session.recorder import Recorder
from slam.timing import StageClock
from slam.tracking.prediction import Prediction, StartPose
from spplanes._check import FloatArray

if TYPE_CHECKING:
    from slam.session.prior_map import PriorMap


class Estimate:
    """The parts of an estimator, and its results so far. Reading changes nothing."""

    def __init__(
        self, config: SlamConfig | None = None, *, prior: PriorMap | None = None, recorder: Recorder | None = None
    ) -> None:
        self.config = config or SlamConfig()
        self.backend = Backend(self.config.backend)
        self.landmarks = LandmarkMap()
        self.clock = StageClock()
        self.audit = NisAudit()
        self.observability = Observability(self.config.observability)
        self.prior = prior
        if prior is not None:
            prior.plant(self.landmarks, self.backend)
        self.recorder = recorder or Recorder()
        self.keyframes: MutableSequence[Keyframe] = self.recorder.keyframes()
        self.decisions: MutableSequence[list[Decision]] = self.recorder.decisions()
        self._thinning = Thinning(self.config.thinning, self.backend, self.landmarks)
        parts = Parts(self.keyframes, self.landmarks, self.backend, self._thinning, self.config)
        self.merges = Merges(parts)
        self._prediction = Prediction(
            parts, None if prior is None else StartPose(prior.world_T_start, prior.start_covariance)
        )
        self._closer = LoopCloser(parts, self.merges)
        self._growth = Growth(parts, self._prediction)

    @property
    def calibration(self) -> WheelCalibration:
        """What has been learnt of the wheels."""
        return self._prediction.calibration

    @property
    def late_matches(self) -> list[LateMatch]:
        """Observations matched after their own keyframe, to landmarks born later."""
        return self._growth.late_matches

    @property
    def loops(self) -> list[LoopDecision]:
        """Every comparison of what was seen with an old place."""
        return self._closer.decisions

    @property
    def trajectory(self) -> Trajectory:
        """world_T_body of every keyframe by the current estimate."""
        poses = np.array([self.backend.pose(pose_symbol(i)) for i in range(len(self.keyframes))])
        stamps = np.array([frame.stamp_ns for frame in self.keyframes], dtype=np.int64)
        return Trajectory(stamps, poses.reshape(-1, 4, 4))

    @property
    def planes(self) -> list[MapPlane]:
        """The map: landmarks seen often enough, in the world, with covariance and outline, in order of birth."""
        wanted = self.config.landmarks.min_observations
        return [
            map_plane(landmark, self.landmarks, self.backend)
            for landmark in self.landmarks
            if landmark.n_keyframes >= wanted
        ]

    @property
    def open_directions(self) -> list[OpenStretch]:
        """Directions that what was seen left open, most frequent first, with what is known of them by all means."""
        stretches = []
        for group in self.observability.directions():
            last = group[-1].keyframe
            key, measured = pose_symbol(last), self.keyframes[last].motion is not None
            source = "odometry" if measured else "the assumption of constant velocity"
            covariance, pose = self.backend.covariance(key), self.backend.pose(key)
            stretches.append(stretch_of(group, len(self.keyframes) - 1, covariance, pose, source))
        return stretches

    @property
    def open_in_map(self) -> list[OpenMapDirection]:
        """Directions in which all planes together, odometry left out, do not fix the keyframes against the first."""
        rules = self.config.observability
        return open_in_map(self._thinning.held, self.keyframes, self.landmarks, self.backend, rules)

    def explain(self, keyframe: int) -> list[str]:
        """Why a keyframe's measurements became what they did, and what it changed in the map; one sentence each.

        Raises:
            ValueError: no such keyframe.
        """
        if not 0 <= keyframe < len(self.decisions):
            raise ValueError(f"keyframe: expected an index from 0 to {len(self.decisions) - 1}, got {keyframe}")
        seen = self.keyframes[keyframe].observations
        sentences = [decision_sentence(one, seen[one.observation]) for one in self.decisions[keyframe]]
        return sentences + change_sentences(keyframe, self.merges.history, self.loops, self._closer.ties)

    def marginal_covariance(self, key: int) -> FloatArray:
        """Marginal covariance of a variable, in its GTSAM tangent order: (rx, ry, rz, x, y, z) for a pose."""
        return self.backend.covariance(key)
