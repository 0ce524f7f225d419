"""Plane-based SLAM: keyframes in, trajectory and planes with covariances out."""

from __future__ import annotations

from collections.abc import MutableSequence, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import gtsam
import numpy as np

from factors import pose_prior
from slam.association import Decision, Hint, associate
from slam.audit import NisAudit
from slam.backend import Backend, pose_symbol
from slam.calibration import WheelCalibration, motion_covariance
from slam.clock import StageClock, timed
from slam.coasting import coast
from slam.config import SlamConfig
from slam.explaining import change_sentences, decision_sentence
from slam.frames import inverse
from slam.health import check_keyframe
from slam.io.trajectories import Trajectory
from slam.keyframes import Keyframe
from slam.landmarks import LandmarkMap, Sighting
from slam.late import LateMatch, Waiting
from slam.loops import LoopDecision, disjoint, find_loop
from slam.loops import Path as DrivenPath
from slam.map_planes import MapPlane, map_plane
from slam.merging import Merges
from slam.observability import Observability, OpenStretch, stretch_of
from slam.odometry import Motion
from slam.places import found_motion, is_wide
from slam.recorder import Recorder
from slam.sights import Sight, birth_sights, matched_sights
from slam.twins import find_twins
from slam.views import step_by_view
from spplanes._check import FloatArray

if TYPE_CHECKING:
    from slam.prior import PriorMap

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
    frame of its anchor pose: one of every so many, before the first that saw it, so that factors have a native form.

    References:
        Weingarten, Gruener, Siegwart, ICRA 2004, for planes and their covariance; here the poses are unknown too.
    """

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
        self.decisions: list[list[Decision]] = []
        self.merges = Merges(self.keyframes, self.landmarks, self.backend, self.config)
        self.loops: list[LoopDecision] = []
        self.late_matches: list[LateMatch] = []
        self._unmatched = Waiting(self.config.landmarks)
        self.calibration = WheelCalibration()
        self._predicted: Motion | None = None
        self._waiting: list[gtsam.NonlinearFactor] = []
        self._standing_in: list[int] = []
        self._since_look_m = 0.0
        self._told_apart: dict[tuple[int, int], int] = {}

    @classmethod
    def open(
        cls, path: Path | str, config: SlamConfig | None = None, *, read_only: bool = False, forget_raw: bool = False
    ) -> Self:
        """An estimator on a session on disk, a new one or one that goes on where it ended.

        What a session holds is replayed, so the estimate is the one that was. Every keyframe added is on the disk
        before the graph uses it.

        Args:
            path: the session's file, or the folder of a run.
            config: of a new session; of an old one None, or the same.
            read_only: only look; another process may be writing meanwhile.
            forget_raw: keep measurements on the disk alone.

        Raises:
            SessionError: no session, a damaged one, one that another process writes, or one of another configuration.
        """
        from slam.session import open_slam  # which needs this class

        return open_slam(cls, path, config, read_only=read_only, forget_raw=forget_raw)

    def close(self) -> None:
        """Let go of the session; without one nothing happens."""
        self.recorder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add_keyframe(self, keyframe: Keyframe) -> KeyframeReport:
        """Predict the pose, match what was seen, update the graph, let the landmarks grow.

        Raises:
            ValueError: the keyframe is not later than the last one, or has a covariance that is none; it left no trace.
        """
        check_keyframe(keyframe, self.keyframes[-1].stamp_ns if len(self.keyframes) else None)
        keyframe = self.recorder.measured(len(self.keyframes), keyframe)
        pose_key = self._predict(keyframe)
        decisions = self._associate(keyframe, pose_key)
        if self._predicted is None or not is_wide(self._predicted):  # else the planes found it: no innovation of theirs
            self.audit.add(len(self.keyframes), (seen.kind for seen in keyframe.observations), decisions)
        self.recorder.decided(len(self.keyframes), decisions)
        self._look_for_open_directions(keyframe, pose_key, decisions)
        touched = self._update(keyframe, pose_key, decisions)
        self._remember(keyframe, decisions)
        self._learn()
        self.landmarks.refresh(self.backend)
        self._match_late(touched)
        self._split_wrong_merges(touched, decisions)
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

    def explain(self, keyframe: int) -> list[str]:
        """Why a keyframe's measurements became what they did, and what it changed in the map; one sentence each.

        Raises:
            ValueError: no such keyframe.
        """
        if not 0 <= keyframe < len(self.decisions):
            raise ValueError(f"keyframe: expected an index from 0 to {len(self.decisions) - 1}, got {keyframe}")
        seen = self.keyframes[keyframe].observations
        sentences = [decision_sentence(one, seen[one.observation]) for one in self.decisions[keyframe]]
        return sentences + change_sentences(keyframe, self.merges.history, self.loops)

    def marginal_covariance(self, key: int) -> FloatArray:
        """Marginal covariance of a variable, in its GTSAM tangent order: (rx, ry, rz, x, y, z) for a pose."""
        return self.backend.covariance(key)

    def optimize_batch(self) -> gtsam.Values:
        """The same graph solved as a batch by Levenberg-Marquardt; the incremental state stays as it is."""
        return self.backend.optimize_batch()

    def adopt_batch(self) -> None:
        """Solve the graph as a batch and go on from there: trajectory, planes and covariances are the batch's."""
        moved = self.backend.rebuild(self.optimize_batch())
        for landmark in self.landmarks:
            landmark.sightings = [replace(one, factor_index=moved[one.factor_index]) for one in landmark.sightings]
        self.landmarks.refresh(self.backend)

    @timed("predict")
    def _predict(self, keyframe: Keyframe) -> int:
        """Put the new pose into the graph with what is known before looking: prior or odometry, and the floor."""
        index = len(self.keyframes)
        key, initial = pose_symbol(index), gtsam.Values()
        if index == 0:
            guess = np.eye(4) if keyframe.world_T_body_guess is None else keyframe.world_T_body_guess
            settings = self.config.backend
            sigmas = np.repeat([settings.prior_sigma_m, settings.prior_sigma_rad], 3)
            covariance = np.diag(sigmas**2)
            if self.prior is not None:
                guess, covariance = self.prior.world_T_start, self.prior.start_covariance
            factors = [pose_prior(key, guess, covariance)]
        else:
            motion = self._predicted = self._motion_to(keyframe)
            guess = self.backend.pose(pose_symbol(index - 1)) @ motion.a_T_b
            factors = motion.factors(pose_symbol(index - 1), key)
            found = None
            if is_wide(motion):
                found = found_motion(keyframe, index, motion, self.backend.pose(pose_symbol(index - 1)), self.landmarks)
            if found is not None:
                self.merges.robust = self.config.coasting.robust or self.config.backend.robust
                guess = self.backend.pose(pose_symbol(index - 1)) @ found.a_T_b
                factors, self._waiting = found.factors(pose_symbol(index - 1), key), factors
        initial.insert(key, gtsam.Pose3(guess))
        indices = self.backend.update(factors, initial)
        self._standing_in = indices if self._waiting else []
        return key

    def _motion_to(self, keyframe: Keyframe) -> Motion:
        """Odometry, less what is known to be wrong with it; without any the motion before goes on."""
        if keyframe.motion is not None:
            return self.calibration.predict(keyframe.motion)
        last, stamps = len(self.keyframes) - 1, [frame.stamp_ns * 1e-9 for frame in self.keyframes[-2:]]
        ahead_s = keyframe.stamp_ns * 1e-9 - stamps[-1]
        if last == 0:
            return coast(None, 0.0, ahead_s, self.config.coasting)
        step = inverse(self.backend.pose(pose_symbol(last - 1))) @ self.backend.pose(pose_symbol(last))
        return coast(step, stamps[1] - stamps[0], ahead_s, self.config.coasting)

    @timed("associate")
    def _associate(self, keyframe: Keyframe, pose_key: int) -> list[Decision]:
        """Which landmark each observation is of, told apart by all returns where there are any."""
        hint = self._hint(keyframe)
        return associate(keyframe.observations, pose_key, self.landmarks, self.backend, self.config.association, hint)

    @timed("compare returns")
    def _hint(self, keyframe: Keyframe) -> Hint | None:
        """The motion to the keyframe by all its returns, for telling walls apart."""
        if not self.keyframes or self._predicted is None:
            return None
        motion = step_by_view(keyframe, self._predicted, self.keyframes, self.backend, self.config.loops)
        return None if motion is None else Hint(pose_symbol(len(self.keyframes) - 1), motion)

    @timed("update")
    def _update(self, keyframe: Keyframe, pose_key: int, decisions: Sequence[Decision]) -> set[int]:
        """Add the factors of matches and of new landmarks, then count what was seen; the ids of those landmarks."""
        seen, initial = keyframe.observations, gtsam.Values()
        every = self.config.landmarks.anchor_every
        anchor_key = pose_symbol(max(len(self.keyframes) - 1, 0) // every * every)
        robust = self.config.coasting.robust if self._standing_in else None
        robust = robust or self.config.backend.robust
        sights = matched_sights(seen, pose_key, decisions, self.landmarks, self.backend, robust)
        sights += birth_sights(
            seen, (anchor_key, pose_key), decisions, self.landmarks, self.backend, self.config, initial
        )
        used = {sight.number for sight in sights}
        self._unmatched.add(len(self.keyframes), keyframe, [i for i in range(len(seen)) if i not in used])
        factors = [*(sight.factor for sight in sights), *self._waiting]
        if not factors:
            return set()
        indices = self.backend.update(factors, initial, remove=self._standing_in, relinearize=True)
        self._waiting, self._standing_in = [], []
        for sight, factor_index in zip(sights, indices, strict=False):
            self._see(sight, len(self.keyframes), factor_index)
        return {sight.landmark.id for sight in sights}

    def _match_late(self, touched: set[int]) -> None:
        """Match what earlier keyframes saw of the landmarks that this one started."""
        at = len(self.keyframes) - 1
        born = {number for number in touched if self.landmarks[number].first_keyframe == at}
        late = self._unmatched.match(born, at, self.keyframes, self.landmarks, self.backend, self.config.association)
        for match in late:
            observations = self.keyframes[match.keyframe].observations
            [sight] = matched_sights(
                observations,
                pose_symbol(match.keyframe),
                [match.decision],
                self.landmarks,
                self.backend,
                self.config.backend.robust,
            )
            [factor_index] = self.backend.update([sight.factor], gtsam.Values(), relinearize=True)
            self._see(sight, match.keyframe, factor_index)
        if late:
            self.landmarks.refresh(self.backend)
        self.late_matches += late

    def _see(self, sight: Sight, keyframe: int, factor_index: int) -> None:
        """Let a landmark know what a keyframe saw of it, now that it is in the graph."""
        sighting = Sighting(keyframe, sight.number, factor_index, sight.observation.kind)
        self.landmarks.see(sight.landmark, sight.observation, sighting, sight.plane_T_body)

    def _look_for_open_directions(self, keyframe: Keyframe, pose_key: int, decisions: Sequence[Decision]) -> None:
        """What of this motion nothing that was seen fixes, said before the graph is asked."""
        matched = [keyframe.observations[one.observation] for one in decisions if one.match is not None]
        self.observability.add(len(self.keyframes), matched, self.backend.pose(pose_key))

    @timed("learn wheels")
    def _learn(self) -> None:
        """What the last motion, now that its end has been seen, says about the wheels."""
        if self._predicted is None or self._predicted.response is None or self.calibration.covariance is None:
            return
        keys = [pose_symbol(len(self.keyframes) - 2), pose_symbol(len(self.keyframes) - 1)]
        a_T_b = inverse(self.backend.pose(keys[0])) @ self.backend.pose(keys[1])
        covariance = motion_covariance(a_T_b, self.backend.joint_covariance(keys).of(keys))
        self.calibration.learn(self._predicted, a_T_b, covariance)

    @timed("twins")
    def _split_wrong_merges(self, touched: set[int], decisions: Sequence[Decision]) -> None:
        """Take back merges that what has been seen since speaks against."""
        compared = {candidate.landmark for decision in decisions for candidate in decision.candidates}
        for merge in self.merges.doubted(touched | compared, self.audit.mean_per_dof):
            if merge.undone is None:
                self.merges.split_if_two(merge)

    @timed("twins")
    def _merge_twins(self, touched: set[int]) -> None:
        """Join landmarks that are one plane: the younger's factors are re-keyed to the older, inside iSAM2."""
        needed, association = self.config.landmarks.min_observations, self.config.association
        pairs = find_twins(
            touched,
            self.landmarks,
            self.backend,
            association,
            min_keyframes=needed,
            told_apart=self._told_apart,
        )
        for older, younger in pairs:
            if self.merges.may_be_one(older, younger):
                self.merges.merge(older, younger, "twins")

    @timed("loops")
    def _close_loops(self) -> None:
        """Every metre or so: is what is seen now a place of long ago? Then its walls are joined with those of then."""
        rules, needed = self.config.loops, self.config.landmarks.min_observations
        keys = [pose_symbol(i) for i in range(len(self.keyframes))]
        if len(keys) > 1:
            self._since_look_m += float(np.linalg.norm(np.subtract(*(self.backend.pose(k)[:3, 3] for k in keys[-2:]))))
        if rules.max_candidates == 0 or self._since_look_m < rules.every_m:
            return
        self._since_look_m = 0.0
        path = DrivenPath.of(keys, self.backend)
        decisions = find_loop(path, self.keyframes, self.landmarks, self.backend, rules, needed)
        self.loops += decisions
        if not decisions or decisions[-1].verdict != "closed":
            return
        pairs = [pair for pair in disjoint(decisions[-1].pairs) if self.merges.may_be_one(*pair)]
        if self.merges.close(pairs, self.audit.mean_per_dof):
            self._told_apart.clear()
            self._merge_twins({older for older, _ in pairs})
            self._take(decisions[-1])

    def _take(self, loop: LoopDecision) -> None:
        """What the returns say of a closed loop beyond its walls: how far along a corridor the robot is."""
        if loop.motion is not None:
            step = loop.motion.factors(pose_symbol(loop.old_keyframe), pose_symbol(loop.keyframe))[0]
            self.backend.update([step], gtsam.Values(), relinearize=True)
            self.landmarks.refresh(self.backend)

    def _remember(self, keyframe: Keyframe, decisions: list[Decision]) -> None:
        self.keyframes.append(keyframe)
        self.decisions.append(decisions)
