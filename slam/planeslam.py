"""Plane-based SLAM: keyframes in, trajectory and planes with covariances out. The algorithm, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import gtsam
import numpy as np

from slam.backend.estimator import Backend, pose_symbol, pose_symbols
from slam.config import SlamConfig
from slam.frontend.input_checks import check_keyframe
from slam.frontend.keyframes import Keyframe
from slam.frontend.measurement import Segment
from slam.io.trajectories import Trajectory
from slam.loop_closure.closing import LoopCloser, LoopClosing
from slam.loop_closure.verification import LoopDecision
from slam.map.data_association import Associate, Decision, Hint, associate
from slam.map.landmarks import LandmarkMap
from slam.map.map_planes import MapPlane, map_planes
from slam.map.sparsification import Sparsifier
from slam.map.state import EstimatorState
from slam.mapping.calibration_errors import CalibrationErrors
from slam.mapping.consistency import NisAudit
from slam.mapping.fusion import Merges
from slam.mapping.map_observability import open_in_map
from slam.mapping.map_update import LateMatch, MapUpdater
from slam.mapping.observability import Observability, OpenStretch
from slam.mapping.same_plane import SamePlaneFinder
from slam.sensors.rig import Rig
from slam.session.explanations import change_sentences, decision_sentence
from slam.session.prior_map import PriorMap
from slam.session.replay import Places, Recorder, open_slam
from slam.timing import StageClock, timed
from slam.tracking.prediction import MotionModel, Prediction, StartPose
from spplanes._check import FloatArray
from spplanes.segmentation.scans import label_scans

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

    Args:
        config: every number.
        prior: a finished map to localise in and to extend.
        recorder: keeps what is measured and decided; a session on disk, or nobody.
        segment: the segmentation that `slam.runs.slam_run.run_slam` measures this estimator's keyframes with.
        associate: data association.
        loop_closer: makes the loop closing out of the shared state and the fusion of landmarks.

    References:
        Weingarten, Gruener, Siegwart, ICRA 2004, for planes and their covariance; here the poses are unknown too.
    """

    def __init__(
        self,
        config: SlamConfig | None = None,
        *,
        prior: PriorMap | None = None,
        recorder: Recorder | None = None,
        segment: Segment = label_scans,
        associate: Associate = associate,
        loop_closer: LoopClosing = LoopCloser,
    ) -> None:
        self.config = config or SlamConfig()
        self.clock = StageClock()
        self.segment = segment
        self.backend, self.landmarks = Backend(self.config.backend), LandmarkMap()
        self.prior, start = prior, None
        if prior is not None:
            prior.plant(self.landmarks, self.backend)
            start = StartPose(prior.world_T_start, prior.start_covariance)
        self.recorder = recorder or Recorder()
        self.keyframes, self.decisions = self.recorder.keyframes, self.recorder.decisions
        self._sparsifier = Sparsifier(self.config.thinning, self.backend, self.landmarks)
        state = EstimatorState(self.keyframes, self.landmarks, self.backend, self._sparsifier, self.config)
        self._motion_model = MotionModel(state, start)
        self._associate, self._loop_closer = associate, loop_closer
        self._map_updater = MapUpdater(state, associate)
        self.backend.share(CalibrationErrors(state).unknown)
        self._same_plane = SamePlaneFinder(state)
        self.merges = Merges(state)
        self._closer = loop_closer(state, self.merges)
        #: What has been learnt of the wheels, and what 3D scans said of the odometry.
        self.calibration, self.odometry_record = self._motion_model.calibration, self._motion_model.odometry_record
        #: Keyframes with a 3D scan that fits nowhere, though little was known of the motion to them; and of every one
        #: placed by what it saw alone, the other places that this fits.
        self.unplaced, self.rivals = self._motion_model.unplaced, self._motion_model.rivals
        #: Keyframes after wheels stood while the robot drove, and how far what was seen there left the way open, m.
        self.left_open = self._motion_model.left_open
        #: Innovations of what was matched, against their chi2; directions that single keyframes left open.
        self.audit, self.observability = NisAudit(), Observability(self.config.observability)
        #: Observations matched after their own keyframe, to landmarks born later.
        self.late_matches: list[LateMatch] = []

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
        return open_slam(cls, path, config, read_only=read_only, forget_raw=forget_raw)

    def close(self) -> None:
        """Let go of the session; without one nothing happens."""
        self.recorder.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add_keyframe(self, keyframe: Keyframe) -> KeyframeReport:
        """Predict the pose, match what was seen, update the graph, let the landmarks grow, close loops.

        The keyframe is kept: its arrays must not be written to afterwards.

        Raises:
            KeyframeError: the keyframe is not later than the last one, or has a covariance that is none; it left no
                trace. A ValueError.
        """
        check_keyframe(keyframe, self.keyframes[-1].stamp_ns if len(self.keyframes) else None, len(self.keyframes))
        keyframe = self.recorder.measured(len(self.keyframes), keyframe)
        prediction = self._predict(keyframe)
        decisions = self._match(keyframe, prediction)
        self.audit.add(keyframe.observations, prediction, decisions, self.landmarks, self.backend)
        self.recorder.decided(prediction.index, decisions)
        self.observability.add(keyframe.observations, prediction, decisions, self.landmarks, self.backend)
        touched = self._update(keyframe, prediction, decisions)
        self._calibrate(prediction)
        self.late_matches += self._match_late(prediction.index, touched)
        self._split_wrong_merges(touched, decisions)
        self._merge_same_planes(touched)
        self._close_loops()
        return KeyframeReport(prediction.index, self.backend.pose(prediction.pose_key), decisions)

    @timed("predict")
    def _predict(self, keyframe: Keyframe) -> Prediction:
        """Put the new pose into the graph with what is known before looking: prior or odometry, and the floor."""
        return self._motion_model.predict(keyframe)

    @timed("associate")
    def _match(self, keyframe: Keyframe, prediction: Prediction) -> list[Decision]:
        """Which landmark each observation is of, told apart by all returns where there are any."""
        motion = None if prediction.motion is None else prediction.motion.scan_matched
        hint = None if motion is None else Hint(pose_symbol(prediction.index - 1), motion)
        known = {"trusted": prediction.trusted, "among": self._of_stretch(prediction)}
        rules = self.config.association
        return self._associate(
            keyframe.observations, prediction.pose_key, self.landmarks, self.backend, rules, hint, **known
        )

    def _of_stretch(self, prediction: Prediction) -> set[int] | None:
        """The landmarks seen in the stretch that a keyframe is in, None: all; see `MotionModel.stretch_of`."""
        start, last = prediction.since, prediction.index
        return {one.id for one in self.landmarks if one.was_seen_between(start, last)} if start else None

    @timed("update")
    def _update(self, keyframe: Keyframe, prediction: Prediction, decisions: list[Decision]) -> set[int]:
        """Add the factors of matches and of new landmarks, then count what was seen; ids of the landmarks touched."""
        touched = self._map_updater.update(keyframe, prediction, decisions)
        self.keyframes.append(keyframe)
        self.decisions.append(decisions)
        return touched

    @timed("learn wheels")
    def _calibrate(self, prediction: Prediction) -> None:
        """What the last motion, now that its end has been seen, says about the wheels."""
        moved_m = self._motion_model.learn(prediction)
        if moved_m is not None:
            self._same_plane.forget()
            self.landmarks.refresh(self.backend)
            self.merges.bent(moved_m)

    @timed("update")
    def _match_late(self, keyframe: int, touched: set[int]) -> list[LateMatch]:
        """Earlier observations of the landmarks that this keyframe started."""
        self.landmarks.refresh(self.backend)
        return self._map_updater.match_late(keyframe, touched)

    @timed("same plane")
    def _split_wrong_merges(self, touched: set[int], decisions: Sequence[Decision]) -> None:
        """Take back merges and closures that what has been seen since speaks against."""
        compared = {candidate.landmark for decision in decisions for candidate in decision.candidates}
        for merge in self.merges.doubted(touched | compared, self.audit.mean_per_dof):
            if merge.undone is None:
                self.merges.split_if_two(merge)
        self._closer.take_back(self.audit.mean_per_dof)

    @timed("same plane")
    def _merge_same_planes(self, touched: Iterable[int]) -> None:
        """Join landmarks that are one plane: the younger's factors are re-keyed to the older, inside iSAM2."""
        for older, younger in self._same_plane.pairs(touched):
            if self._may_be_told(older, younger) and self.merges.may_be_one(older, younger):
                self.merges.merge(older, younger, "same plane")

    def _may_be_told(self, *ids: int) -> bool:
        """Whether it is known where landmarks, by id, lie to each other: they are of one stretch."""
        return len({self._motion_model.stretch_of(self.landmarks[one].first_keyframe) for one in ids}) == 1

    @timed("loops")
    def _close_loops(self) -> None:
        """Every metre or so: is what is seen now a place of long ago? Then its walls are joined with those of then."""
        closure = self._closer.look(self.audit.mean_per_dof)
        if closure is not None:
            self._same_plane.forget()
            self._merge_same_planes({older for older, _ in closure.pairs})
            self._closer.fix(closure)

    def anew(self, prior: PriorMap | None) -> PlaneSlam:
        """An estimator like this one before its first keyframe, recorded by nobody, in a prior map or in none."""
        parts = {"segment": self.segment, "associate": self._associate, "loop_closer": self._loop_closer}
        slam = type(self)(self.config, prior=prior, **parts)
        slam.clock = slam.backend.clock = self.clock
        return slam

    def remap(
        self, places: Places, prior: PriorMap | None, progress: Callable[[int, int], None] | None = None
    ) -> PlaneSlam:
        """The same keyframes through a new estimator, which knows beforehand what places some of them stand near.

        This one stays as it is, and so does what is recorded, until the new one is to `supersede` it.

        Args:
            places: by index of the keyframe; they take the place of those that it has.
            prior: the map to localise in, and where in it the first keyframe is.
            progress: is told how many keyframes are done, and how many there are.
        """
        slam = self.anew(prior)
        for index, keyframe in enumerate(self.keyframes):
            slam.add_keyframe(replace(keyframe, places=places[index]) if index in places else keyframe)
            if progress is not None:
                progress(index + 1, len(self.keyframes))
        return slam

    def supersede(self, first: PlaneSlam, places: Places) -> None:
        """From here on this is the run: what was recorded of the `first` is replaced by what this one decided."""
        start = None if self.prior is None else self.prior.world_T_start
        first.recorder.mended(places, start, self.decisions)
        self.recorder = first.recorder

    def supersede_measured(self, first: PlaneSlam, rig: Rig) -> None:
        """From here on this is the run, of the same scans measured anew with a rig that says more of the sensors."""
        first.recorder.measured_anew(rig, self.keyframes, self.decisions)
        self.recorder = first.recorder

    def optimize_batch(self) -> gtsam.Values:
        """The same graph solved as a batch by Levenberg-Marquardt; the incremental state stays as it is."""
        return self.backend.optimize_batch()

    def adopt_batch(self) -> None:
        """Solve the graph as a batch and go on from there: trajectory, planes and covariances are the batch's."""
        self.backend.rebuild(self.optimize_batch())
        self.landmarks.refresh(self.backend)

    @property
    def trajectory(self) -> Trajectory:
        """world_T_body of every keyframe by the current estimate."""
        stamps = np.array([frame.stamp_ns for frame in self.keyframes], dtype=np.int64)
        return Trajectory(stamps, self.backend.poses(pose_symbols(range(len(stamps)))))

    @property
    def planes(self) -> list[MapPlane]:
        """The map: landmarks seen often enough, in the world, with covariance and outline, in order of birth."""
        return map_planes(self.landmarks, self.backend, self.config.landmarks.min_observations)

    def marginal_covariance(self, key: int) -> FloatArray:
        """Marginal covariance of a variable, in its GTSAM tangent order: (rx, ry, rz, x, y, z) for a pose.

        Where errors of the wheels' calibration were found, or a camera's is left open, the first one after a keyframe
        takes as long as eliminating the whole graph: what is open about them is in it.
        """
        return self.backend.read_covariance(key)

    @property
    def loops(self) -> list[LoopDecision]:
        """Every comparison of what was seen with an old place."""
        return self._closer.decisions

    @property
    def open_directions(self) -> list[OpenStretch]:
        """Directions that what was seen left open, most frequent first, with what is known of them by all means."""
        return self.observability.stretches(self.keyframes, self.backend)

    @property
    def open_in_map(self) -> list[OpenStretch]:
        """Directions in which all planes together, odometry left out, do not fix the keyframes against the first."""
        rules = self.config.observability
        return open_in_map(self._sparsifier.held, self.keyframes, self.landmarks, self.backend, rules)

    def explain(self, keyframe: int) -> list[str]:
        """Why a keyframe's measurements became what they did, and what it changed in the map; one sentence each.

        Raises:
            ValueError: no such keyframe.
        """
        if not 0 <= keyframe < len(self.decisions):
            raise ValueError(f"keyframe: expected an index from 0 to {len(self.decisions) - 1}, got {keyframe}")
        seen = self.keyframes[keyframe].observations
        sentences = [decision_sentence(one, seen[one.observation]) for one in self.decisions[keyframe]]
        return sentences + change_sentences(keyframe, self.merges.history, self.loops, self._closer.closed)
