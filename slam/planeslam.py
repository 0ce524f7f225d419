"""Plane-based SLAM: keyframes in, trajectory and planes with covariances out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import gtsam

from slam.association.data_association import Decision, Hint, associate
from slam.backend.estimator import pose_symbol
from slam.config import SlamConfig
from slam.diagnostics.pose_free_innovations import innovations_without_prediction
from slam.estimate import Estimate
from slam.frontend.input_checks import check_keyframe
from slam.frontend.keyframes import Keyframe
from slam.map.map_planes import MapPlane
from slam.mapping.same_plane import find_twins
from slam.registration.submaps import step_by_view
from slam.session.recorder import Recorder
from slam.timing import timed
from spplanes._check import FloatArray

if TYPE_CHECKING:
    from slam.session.prior_map import PriorMap

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


class PlaneSlam(Estimate):
    """Incremental plane-based SLAM on iSAM2.

    Poses are gtsam Pose3 variables under symbols x0, x1, ...; landmarks OrientedPlane3 under p0, p1, ..., each in the
    frame of its anchor pose: one of every so many, before the first that saw it, so that factors have a native form.

    References:
        Weingarten, Gruener, Siegwart, ICRA 2004, for planes and their covariance; here the poses are unknown too.
    """

    def __init__(
        self, config: SlamConfig | None = None, *, prior: PriorMap | None = None, recorder: Recorder | None = None
    ) -> None:
        super().__init__(config, prior=prior, recorder=recorder)
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
        from slam.session.replay import open_slam  # which needs this class

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

        The keyframe is kept: its arrays must not be written to afterwards.

        Raises:
            ValueError: the keyframe is not later than the last one, or has a covariance that is none; it left no trace.
        """
        check_keyframe(keyframe, self.keyframes[-1].stamp_ns if len(self.keyframes) else None)
        keyframe = self.recorder.measured(len(self.keyframes), keyframe)
        pose_key = self._predict(keyframe)
        decisions = self._associate(keyframe, pose_key)
        self._audit(keyframe, pose_key, decisions)
        self.recorder.decided(len(self.keyframes), decisions)
        self._look_for_open_directions(keyframe, pose_key, decisions)
        touched = self._update(keyframe, pose_key, decisions)
        self.keyframes.append(keyframe)
        self.decisions.append(decisions)
        self._learn()
        self.landmarks.refresh(self.backend)
        self._growth.match_late(touched)
        self._split_wrong_merges(touched, decisions)
        self._merge_twins(touched)
        self._close_loops()
        return KeyframeReport(len(self.keyframes) - 1, self.backend.pose(pose_key), decisions)

    def optimize_batch(self) -> gtsam.Values:
        """The same graph solved as a batch by Levenberg-Marquardt; the incremental state stays as it is."""
        return self.backend.optimize_batch()

    def adopt_batch(self) -> None:
        """Solve the graph as a batch and go on from there: trajectory, planes and covariances are the batch's."""
        moved = self.backend.rebuild(self.optimize_batch())
        for landmark in self.landmarks:
            landmark.sightings = [replace(one, factor_index=moved[one.factor_index]) for one in landmark.sightings]
        self._thinning.renumber(moved)
        self._closer.renumber(moved)
        self.landmarks.refresh(self.backend)

    @timed("predict")
    def _predict(self, keyframe: Keyframe) -> int:
        """Put the new pose into the graph with what is known before looking: prior or odometry, and the floor."""
        key = self._prediction.enter(keyframe)
        if self._prediction.waiting:  # from then on merges are made by measurements some of which may be wrong
            self.merges.robust = self.config.coasting.robust or self.config.backend.robust
        return key

    @timed("associate")
    def _associate(self, keyframe: Keyframe, pose_key: int) -> list[Decision]:
        """Which landmark each observation is of, told apart by all returns where there are any."""
        found, rules = self._prediction.found, self.config.association
        trusted = None if found is None else found.trusted
        hint = self._hint(keyframe)
        return associate(keyframe.observations, pose_key, self.landmarks, self.backend, rules, hint, trusted=trusted)

    @timed("compare returns")
    def _hint(self, keyframe: Keyframe) -> Hint | None:
        """The motion to the keyframe by all its returns, for telling walls apart."""
        if not self.keyframes or self._prediction.motion is None:
            return None
        matched = self._prediction.motion.returns_covariance
        if matched is not None:
            motion = replace(self._prediction.motion, covariance=matched)
            return Hint(pose_symbol(len(self.keyframes) - 1), motion)
        motion = step_by_view(keyframe, self._prediction.motion, self.keyframes, self.backend, self.config.loops)
        return None if motion is None else Hint(pose_symbol(len(self.keyframes) - 1), motion)

    def _audit(self, keyframe: Keyframe, pose_key: int, decisions: Sequence[Decision]) -> None:
        """Hold what was matched against what was known: without odometry nothing of the pose."""
        index, seen = len(self.keyframes), keyframe.observations
        if not self._prediction.is_wide:
            self.audit.add(index, [one.kind for one in seen], decisions)
            return
        for number, chi2, dof in innovations_without_prediction(
            seen, decisions, pose_key, self.landmarks, self.backend
        ):
            self.audit.count(index, seen[number].kind, chi2, dof)

    @timed("update")
    def _update(self, keyframe: Keyframe, pose_key: int, decisions: Sequence[Decision]) -> set[int]:
        """Add the factors of matches and of new landmarks, then count what was seen; the ids of those landmarks."""
        return self._growth.update(keyframe, pose_key, decisions)

    def _look_for_open_directions(self, keyframe: Keyframe, pose_key: int, decisions: Sequence[Decision]) -> None:
        """What of this motion nothing that was seen fixes, said before the graph is asked."""
        matched = [keyframe.observations[one.observation] for one in decisions if one.match is not None]
        self.observability.add(len(self.keyframes), matched, self.backend.pose(pose_key))

    @timed("learn wheels")
    def _learn(self) -> None:
        """What the last motion, now that its end has been seen, says about the wheels."""
        self._prediction.learn()

    @timed("twins")
    def _split_wrong_merges(self, touched: set[int], decisions: Sequence[Decision]) -> None:
        """Take back merges that what has been seen since speaks against."""
        compared = {candidate.landmark for decision in decisions for candidate in decision.candidates}
        for merge in self.merges.doubted(touched | compared, self.audit.mean_per_dof):
            if merge.undone is None:
                self.merges.split_if_two(merge)
        self._closer.take_back(self.audit.mean_per_dof)

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
        pairs = self._closer.look(self.audit.mean_per_dof)
        if pairs is not None:
            self._told_apart.clear()
            self._merge_twins({older for older, _ in pairs})
            self._closer.take_motion(pairs)
