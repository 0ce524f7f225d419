"""Plane-based SLAM: keyframes in, trajectory and planes with covariances out."""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from factors import pose_prior
from slam.association import Decision, associate
from slam.audit import NisAudit
from slam.backend import Backend, pose_symbol
from slam.calibration import WheelCalibration, motion_covariance
from slam.config import SlamConfig
from slam.frames import inverse
from slam.io.trajectories import Trajectory
from slam.keyframes import Keyframe
from slam.landmarks import LandmarkMap, Sighting
from slam.loops import LoopDecision, Path, disjoint, find_loop
from slam.map_planes import MapPlane, map_plane
from slam.merging import absorb
from slam.odometry import Motion
from slam.recorder import Recorder
from slam.sights import birth_sights, matched_sights
from slam.twins import find_twins
from spplanes._check import FloatArray

__all__ = ["KeyframeReport", "MapPlane", "PlaneSlam", "pose_symbol"]


@dataclass(frozen=True, eq=False)
class KeyframeReport:
    """What `add_keyframe` did."""

    keyframe: int
    """Index of the keyframe."""
    world_T_body: FloatArray
    """Estimated pose after the update, shape (4, 4)."""
    decisions: list[Decision]
    """One for every observation of the keyframe, in their order."""


class PlaneSlam:
    """Incremental plane-based SLAM on iSAM2.

    Poses are gtsam Pose3 variables under symbols x0, x1, ...; landmarks OrientedPlane3 under p0, p1, ..., each in the
    frame of its anchor pose: the one before the first that saw it, so that every factor has a native form.

    References:
        Weingarten, Gruener, Siegwart, ICRA 2004, for planes and their covariance; here the poses are unknown too.
    """

    def __init__(self, config: SlamConfig | None = None, *, recorder: Recorder | None = None) -> None:
        self.config = config or SlamConfig()
        self.backend = Backend(self.config.backend)
        self.landmarks = LandmarkMap()
        self.audit = NisAudit()
        self.recorder = recorder or Recorder()
        self.keyframes: MutableSequence[Keyframe] = self.recorder.keyframes()
        self.decisions: list[list[Decision]] = []
        self.merges: list[tuple[int, int, int]] = []
        self.loops: list[LoopDecision] = []
        self.calibration = WheelCalibration()
        self._predicted: Motion | None = None
        self._loops_looked_for_at = 0.0

    def add_keyframe(self, keyframe: Keyframe) -> KeyframeReport:
        """Predict the pose, match what was seen, update the graph, let the landmarks grow.

        Raises:
            ValueError: the keyframe is not later than the last one, or lacks the motion that leads to it.
        """
        self._check_order(keyframe)
        keyframe = self.recorder.measured(len(self.keyframes), keyframe)
        pose_key = self._predict(keyframe)
        decisions = associate(keyframe.observations, pose_key, self.landmarks, self.backend, self.config.association)
        self.audit.add(len(self.keyframes), (seen.kind for seen in keyframe.observations), decisions)
        self.recorder.decided(len(self.keyframes), decisions)
        touched = self._update(keyframe, pose_key, decisions)
        self._remember(keyframe, decisions)
        self._learn()
        self.landmarks.refresh(self.backend)
        self._merge_twins(touched)
        self._close_loops()
        return KeyframeReport(len(self.keyframes) - 1, self.backend.pose(pose_key), decisions)

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

    def marginal_covariance(self, key: int) -> FloatArray:
        """Marginal covariance of a variable, in its GTSAM tangent order: (rx, ry, rz, x, y, z) for a pose."""
        return self.backend.covariance(key)

    def optimize_batch(self) -> gtsam.Values:
        """The same graph solved as a batch by Levenberg-Marquardt; the incremental state stays as it is."""
        return self.backend.optimize_batch()

    def _check_order(self, keyframe: Keyframe) -> None:
        if not self.keyframes:
            return
        last = self.keyframes[-1].stamp_ns
        if keyframe.stamp_ns <= last:
            raise ValueError(f"keyframe: expected a time after {last} ns, got {keyframe.stamp_ns} ns")
        if keyframe.motion is None:
            raise ValueError("keyframe: expected the motion from the keyframe before, got None")

    def _predict(self, keyframe: Keyframe) -> int:
        """Put the new pose into the graph with what is known before looking: prior or odometry, and the floor."""
        index = len(self.keyframes)
        key, initial = pose_symbol(index), gtsam.Values()
        if index == 0 or keyframe.motion is None:
            guess = np.eye(4) if keyframe.world_T_body_guess is None else keyframe.world_T_body_guess
            settings = self.config.backend
            sigmas = np.repeat([settings.prior_sigma_m, settings.prior_sigma_rad], 3)
            factors = [pose_prior(key, guess, np.diag(sigmas**2))]
        else:
            motion = self._predicted = self.calibration.predict(keyframe.motion)
            guess = self.backend.pose(pose_symbol(index - 1)) @ motion.a_T_b
            factors = motion.factors(pose_symbol(index - 1), key)
        initial.insert(key, gtsam.Pose3(guess))
        self.backend.update(factors, initial)
        return key

    def _update(self, keyframe: Keyframe, pose_key: int, decisions: Sequence[Decision]) -> set[int]:
        """Add the factors of matches and of new landmarks, then count what was seen; the ids of those landmarks."""
        seen, initial = keyframe.observations, gtsam.Values()
        anchor_key = pose_symbol(max(len(self.keyframes) - 1, 0))
        sights = matched_sights(seen, pose_key, decisions, self.landmarks, self.backend, self.config)
        sights += birth_sights(
            seen, (anchor_key, pose_key), decisions, self.landmarks, self.backend, self.config, initial
        )
        if not sights:
            return set()
        indices = self.backend.update([sight.factor for sight in sights], initial, relinearize=True)
        for sight, factor_index in zip(sights, indices, strict=True):
            sighting = Sighting(len(self.keyframes), sight.number, factor_index, sight.observation.kind)
            self.landmarks.see(sight.landmark, sight.observation, sighting, sight.plane_T_body)
        return {sight.landmark.id for sight in sights}

    def _learn(self) -> None:
        """What the last motion, now that its end has been seen, says about the wheels."""
        if self._predicted is None or self._predicted.response is None or self.calibration.covariance is None:
            return
        keys = [pose_symbol(len(self.keyframes) - 2), pose_symbol(len(self.keyframes) - 1)]
        a_T_b = inverse(self.backend.pose(keys[0])) @ self.backend.pose(keys[1])
        covariance = motion_covariance(a_T_b, self.backend.joint_covariance(keys).of(keys))
        self.calibration.learn(self._predicted, a_T_b, covariance)

    def _merge_twins(self, touched: set[int]) -> None:
        """Join landmarks that are one plane: the younger's factors are re-keyed to the older, inside iSAM2."""
        needed, association = self.config.landmarks.min_observations, self.config.association
        for older, younger in find_twins(touched, self.landmarks, self.backend, association, min_keyframes=needed):
            self._merge(older, younger)

    def _close_loops(self) -> None:
        """Every metre or so: is what is seen now a place of long ago? Then its walls are joined with those of then."""
        rules, needed = self.config.loops, self.config.landmarks.min_observations
        path = Path.of([pose_symbol(i) for i in range(len(self.keyframes))], self.backend)
        if rules.max_candidates == 0 or path.lengths[-1] < self._loops_looked_for_at + rules.every_m:
            return
        self._loops_looked_for_at = float(path.lengths[-1])
        decisions = find_loop(path, self.landmarks, self.backend, rules, needed)
        self.loops += decisions
        if not decisions or decisions[-1].verdict != "closed":
            return
        touched: set[int] = set()
        for older, younger in disjoint(decisions[-1].pairs):
            self._merge(older, younger)
            touched.add(older)
        self._merge_twins(touched)

    def _merge(self, older: int, younger: int) -> None:
        """Make two landmarks one, and remember it."""
        robust = self.config.backend.robust
        gone = self.landmarks.remove(younger)
        absorb(self.landmarks[older], gone, self.keyframes, self.landmarks, self.backend, robust)
        self.merges.append((len(self.keyframes) - 1, older, younger))
        self.landmarks.refresh(self.backend)

    def _remember(self, keyframe: Keyframe, decisions: list[Decision]) -> None:
        self.keyframes.append(keyframe)
        self.decisions.append(decisions)
