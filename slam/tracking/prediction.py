"""Tracking, the first step of a keyframe: its pose enters the graph by its motion alone, before looking."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import gtsam
import numpy as np
from scipy.special import chdtri

from factors import constant_velocity_factor, pose_prior
from slam.backend.estimator import pose_symbol
from slam.backend.joint_covariance import carried, motion_covariance, relative_covariance
from slam.config import BOUND_SIGMAS, CoastingConfig
from slam.frontend.information import information_beyond_lines, inverted
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import NO_FLOOR, Motion, difference, planar_delta
from slam.frontend.pose_measurements import PlaceMatch
from slam.frontend.wheel_calibration import WheelCalibration
from slam.geometry.frames import inverse, orthonormal, planar_transform
from slam.map.sparsification import Link
from slam.map.state import EstimatorState
from slam.registration.motion_prior import MotionPrior, VelocityPrior
from slam.registration.relocalization import (
    FoundPlace,
    Rivals,
    displacement,
    found_place,
    is_poorly_known,
    place_of,
    planes_about,
    scan_of,
    sigmas_of,
    where_expected,
)
from slam.registration.submaps import anchored
from slam.tracking.calibration_by_graph import CalibrationByGraph
from slam.tracking.odometry_check import check
from slam.tracking.odometry_record import OdometryRecord
from slam.tracking.odometry_scale import OdometryScale, scaled
from spplanes._check import FloatArray
from spplanes.spmodel import transform_from_rpy


@dataclass(frozen=True, eq=False)
class _Step:
    """Where a keyframe is expected, and the factors that say so."""

    world_T_body: FloatArray
    factors: list[Any]
    motion: Motion | None = None
    place: FoundPlace | None = None
    pending: list[Any] = field(default_factory=list)
    beyond: Motion | None = None
    """What the returns say beyond all lines seen, where no wheels measured it: it stands in until these are matched."""
    planes_asked: bool = False
    measured: Motion | None = None
    """The motion that came with the keyframe, as its factor has it but for errors of calibration; None: none has."""


class StartPose(NamedTuple):
    """Where a run starts, as somebody knew it before."""

    world_T_body: FloatArray
    """Shape (4, 4)."""
    covariance: FloatArray
    """Shape (6, 6), in the SP order (x, y, z, phi, theta, psi), composed on the right."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """The pose of a keyframe before anything is looked at, as it stands in the graph."""

    index: int
    """Index of the keyframe."""
    pose_key: int
    """Its key in the graph."""
    motion: Motion | None
    """The motion that leads there, as it is known; None for the first keyframe."""
    place: FoundPlace | None = None
    """Where the planes found the keyframe, if they were asked and could say."""
    pending: tuple[gtsam.NonlinearFactor, ...] = ()
    """Factors of the motion that the place stands in for: they enter the graph together with what was seen."""
    standing_in: tuple[int, ...] = ()
    """Indices of the factors of that place, or of what the returns say beyond all lines, which leave it then: they are
    made of what was seen."""
    planes_asked: bool = False
    """Whether nobody measured the motion, or so badly that the planes were asked, or the scan was laid."""
    robust: str | None = None
    """Robust kernel on what is matched from here: of a place that the planes had to find some of it is wrong."""
    hints: tuple[int, ...] = ()
    """Indices of factors that say where to look, and leave the graph when it has been looked."""
    since: int = 0
    """The first keyframe of the stretch of the drive that it is in; see `MotionModel.stretch_of`."""

    @property
    def trusted(self) -> frozenset[int] | None:
        """Observations that may be matched from here; None: all."""
        return None if self.place is None else self.place.trusted


class MotionModel:
    """Odometry less what has been learnt of the wheels; without any the motion before, or that which the planes tell.

    The last stands in for the wide motion that is known, while observations are matched and no longer: it is made of
    what they will say.
    """

    def __init__(self, state: EstimatorState, start: StartPose | None) -> None:
        self._state, self._keyframes, self._backend = state, state.keyframes, state.backend
        self._sparsifier, self._config, self._known_start = state.sparsifier, state.config, start
        self.calibration = WheelCalibration()
        #: Keyframes with a 3D scan that fits nowhere, though little was known of the motion to them.
        self.unplaced: list[int] = []
        #: Keyframes after wheels stood while the robot drove, and how far their planes, all that was seen, leave the
        #: way there open, m: on a motion that goes on as before there is at least its velocity.
        self.left_open: dict[int, float] = {}
        #: Of every keyframe placed by what it saw alone, the other places that this fits.
        self.rivals: dict[int, Rivals] = {}
        self.odometry_record = OdometryRecord(state.config.association.new_significance)
        self.odometry_scale = OdometryScale()
        self.velocity_prior = VelocityPrior()
        #: What was expected of the last motion, and what the graph holds of it; None: of an assumption nothing.
        self._expected: tuple[MotionPrior, Motion | None] | None = None
        self._by_graph = CalibrationByGraph(self._sparsifier, self._backend, self.calibration)

    def stretch_of(self, keyframe: int) -> int:
        """The first keyframe of the stretch that one is in: with a scan that fits nowhere another begins.

        Where that lies in what was before is known by nothing: planes of the two would be taken for one by chance, and
        by a few of these the body is anywhere. A prior map it may be found in.
        """
        if self._known_start is not None:
            return 0
        before = [start for start in self.unplaced if start <= keyframe]
        return before[-1] if before else 0

    def predict(self, keyframe: Keyframe) -> Prediction:
        """Put the pose of a new keyframe into the graph, where others may leave it."""
        index = len(self._keyframes)
        known = next((place for place in keyframe.places if place.is_spatial), None)
        if known is not None:
            keyframe = replace(keyframe, motion=self._motion_by(known))
        step = self._start(keyframe) if index == 0 else self._step(keyframe, index)
        key, initial = pose_symbol(index), gtsam.Values()
        initial.insert(key, gtsam.Pose3(orthonormal(step.world_T_body)))
        beyond = [] if step.beyond is None else [step.beyond.factor(pose_symbol(index - 1), key)]
        hints = self._hints(keyframe, step.world_T_body, key)
        measured = [measurement.factor(key) for measurement in keyframe.pose_measurements]
        own_factors = [*step.factors, *beyond, *measured, *hints]
        removal = self._sparsifier.plan_removal(index)
        through = [
            self.calibration.corrected(motion).factor(pose_symbol(first), pose_symbol(last))
            for first, last, motion in removal.motions  # as measured, through keyframes that have left
        ]
        indices = self._backend.update([*own_factors, *through], initial, remove=removal.stale)
        own = indices[: len(own_factors)]
        self._sparsifier.removed(removal, indices[len(own_factors) :])
        n_step, n_stay = len(step.factors), len(own) - len(hints)
        standing_in = own[:1] if step.pending else own[n_step : n_step + len(beyond)]
        floor = own[1:n_step] + own[n_step + len(beyond) : n_stay]
        tie = [] if step.pending else own[:1]
        link = None if step.measured is None else Link(_with(step.measured, step.beyond), tie, floor)
        self._sparsifier.entered(index, link)
        return Prediction(
            index,
            key,
            step.motion,
            step.place,
            pending=tuple(step.pending),
            standing_in=tuple(standing_in),
            planes_asked=step.planes_asked,
            robust=(self._config.coasting.robust if step.pending else None) or self._config.backend.robust,
            hints=tuple(own[n_stay:]),
            since=self.stretch_of(index),
        )

    def _motion_by(self, known: PlaceMatch) -> Motion:
        """The motion to a keyframe from the last one, by where it is from one before."""
        there, last = pose_symbol(known.keyframe), pose_symbol(len(self._keyframes) - 1)
        last_T_there, spread = self._backend.relative_pose(last, there)
        there_T_new = transform_from_rpy(known.delta)
        covariance = carried(spread, there_T_new) + known.covariance
        return Motion(last_T_there @ there_T_new, 0.5 * (covariance + covariance.T), NO_FLOOR)

    def _hints(self, keyframe: Keyframe, world_T_body: FloatArray, key: int) -> list[Any]:
        """Factors of where a keyframe is known to be from earlier ones, where the prediction says otherwise.

        By what is known of that and by more than what passes for tied: a wall is taken for another by decimetres.
        """
        rules, factors = self._config.loops, []
        tied = rules.tied_m / BOUND_SIGMAS * np.array((1.0, 1.0, 1.0 / rules.window_m))
        for match in (place for place in keyframe.places if place.inferred):
            base, pose = anchored(match, self._backend)
            expected = planar_delta(inverse(self._backend.pose(base)) @ world_T_body)
            is_off = pose.misfit(expected) > chdtri(3, rules.significance)
            if is_off and np.any(np.abs(difference(expected, pose.delta)) > tied):
                factors.append(Motion(planar_transform(*pose.delta), pose.covariance, NO_FLOOR).factor(base, key))
        return factors

    def learn(self, prediction: Prediction) -> float | None:
        """What a motion, now that its end has been seen, says about the wheels, and every so often all of them.

        By how much poses moved at most, m, where all steps so far have other factors now; None: none has.
        """
        motion, moved_m = prediction.motion, self._by_graph.learn()
        if moved_m is not None or motion is None or motion.response is None or not np.any(motion.calibration_sigmas):
            return moved_m
        keys = [pose_symbol(prediction.index - 1), prediction.pose_key]
        a_T_b = inverse(self._backend.pose(keys[0])) @ self._backend.pose(keys[1])
        covariance = motion_covariance(a_T_b, self._backend.joint_covariance(keys).of(keys))
        self.calibration.learn(motion, a_T_b, covariance)
        return None

    def _start(self, keyframe: Keyframe) -> _Step:
        """Where the first keyframe is, and its prior."""
        guess = np.eye(4) if keyframe.world_T_body_guess is None else keyframe.world_T_body_guess
        settings = self._config.backend
        covariance = np.diag(np.repeat([settings.prior_sigma_m, settings.prior_sigma_rad], 3) ** 2)
        if self._known_start is not None:
            guess, covariance = self._known_start
        return _Step(guess, [pose_prior(pose_symbol(0), guess, covariance)])

    def _step(self, keyframe: Keyframe, index: int) -> _Step:
        """Where the motion to a keyframe leads, and its factors."""
        before, key = pose_symbol(index - 1), pose_symbol(index)
        world_T_before = self._backend.pose(before)
        motion, prior, place = self._motion_to(keyframe)
        beyond = information_beyond_lines(motion, keyframe.observations) if motion.is_by_returns else None
        wide = is_poorly_known(motion.scan_matched or motion)
        asked = wide or keyframe.motion is None  # what went on as before was not measured, however well it is known
        assumed = prior if prior is not None and motion is prior.motion else None
        if asked:
            place = found_place(keyframe, motion, self._state, assumed)
        if wide and place is None and keyframe.surfaces is not None:
            self.unplaced.append(index)
        found = motion if place is None else place.motion
        by_planes_alone = keyframe.surfaces is None and keyframe.returns is None
        if by_planes_alone and not motion.is_measured and is_poorly_known(found):
            self.left_open[index] = sigmas_of(found)[0]
        if assumed is not None:
            motion = assumed.learnt() if place is None else place.expected
        self._expected = None if prior is None else (prior, None if assumed is None else motion)
        step = motion.factor(before, key) if assumed is None else self._goes_on(motion, assumed, keyframe.stamp_ns)
        floor = motion.floor_factors(key)
        measured = self._measured(keyframe, motion) if place is None or not asked else None
        if place is None:
            there = world_T_before @ motion.a_T_b
            return _Step(there, [step, *floor], motion, beyond=beyond, planes_asked=asked, measured=measured)
        self.rivals[index] = place.rivals
        kernel, there = self._config.coasting.robust or self._config.backend.robust, place.motion
        pending = [step, *place.factors(before, key, kernel)]
        factors, world_T_body = [there.factor(before, key), *floor], world_T_before @ there.a_T_b
        return _Step(world_T_body, factors, motion, place, pending, planes_asked=True, measured=measured)

    def _goes_on(self, motion: Motion, prior: MotionPrior, stamp_ns: int) -> gtsam.CustomFactor:
        """A motion that nobody measured, as a factor of the one before it as well: they err alike.

        However long nobody sees it, its velocity stays within what is likely of a body of which nothing is known.
        """
        before_s, ahead_s = self._seconds(stamp_ns)
        change = np.diag(motion.covariance) - prior.before
        any_speed = np.diag(coast(None, 0.0, ahead_s, self._config.coasting).covariance)
        kept = ahead_s / before_s * np.sqrt(np.clip(1.0 - change / any_speed, 0.0, 1.0))
        index = len(self._keyframes)
        self._sparsifier.stays(index - 2)
        return constant_velocity_factor([pose_symbol(index - k) for k in (2, 1, 0)], np.diag(change), kept=kept)

    def _seconds(self, stamp_ns: int) -> tuple[float, float]:
        """How long the last motion took, 0 where there was none, and the one from there on takes, s."""
        stamps = [frame.stamp_ns for frame in self._keyframes[-2:]]
        return (stamps[-1] - stamps[0]) * 1e-9, (stamp_ns - stamps[-1]) * 1e-9

    def _motion_to(self, keyframe: Keyframe) -> tuple[Motion, MotionPrior | None, FoundPlace | None]:
        """Odometry, less what is known to be wrong with it; without any the motion before goes on.

        Odometry that a 3D scan speaks against is a guess: it is as wide as if nobody had measured it.

        Returns:
            The motion; what would be expected of it had nobody measured it, None: there was no motion before; and the
            place where the scan was laid, None: it has nothing to add to the motion, or speaks against it.
        """
        last, rules = len(self._keyframes) - 1, self._config.coasting
        before_s, ahead_s = self._seconds(keyframe.stamp_ns)
        guess = coast(None, 0.0, ahead_s, rules)
        prior = self._unmeasured(keyframe, last, before_s, ahead_s) if last > 0 else None
        unmeasured = guess if prior is None else prior.motion
        if keyframe.motion is None:
            return unmeasured, prior, None
        record = self.odometry_record
        stated = self.calibration.predict(keyframe.motion)
        motion = scaled(stated, self.odometry_scale.factor)
        said, laid = check(
            keyframe,
            motion,
            replace(guess, a_T_b=unmeasured.a_T_b),
            self._state,
            significance=record.significance,
            again=record.again,
            prior=prior or self.velocity_prior.prior(guess, np.diag(guess.covariance), np.zeros(6)),
        )
        if said.off is not None and said.known is not None:
            self.odometry_scale.learn(stated, said.off, said.known, guess)
            motion = scaled(stated, self.odometry_scale.factor)  # this step is one of those that tell
        used = record.take(last + 1, motion, unmeasured, guess, said, self.odometry_scale.factor)
        if laid is None or used is unmeasured:
            return used, prior, None
        about = planes_about(keyframe, self._state, where_expected(used, self._state))
        return used, prior, place_of(keyframe, used, laid, *about)

    def _unmeasured(self, keyframe: Keyframe, last: int, before_s: float, ahead_s: float) -> MotionPrior:
        """What is expected of the motion to a keyframe, after one of so many seconds, had nobody measured it."""
        known, adrift, rules = None, np.zeros(6), self._config.coasting
        seen, before, end = (pose_symbol(frame) for frame in (self._seen_last(), last - 1, last))
        way, step = (inverse(self._backend.pose(start)) @ self._backend.pose(end) for start in (seen, before))
        self.odometry_record.settle(step)
        if keyframe.motion is None:
            joint = self._backend.joint_covariance(sorted({seen, before, end}))
            known = relative_covariance(step, joint.of([before, end]))
            adrift = np.diag(relative_covariance(way, joint.of([seen, end])))
        if self._expected is not None:
            prior, used = self._expected
            self.velocity_prior.learn(prior, displacement(prior.motion.a_T_b, step), used, known)
        change = np.diag(coast(step, before_s, ahead_s, rules).covariance)
        return self.velocity_prior.prior(coast(step, before_s, ahead_s, rules, known), change, adrift)

    def _seen_last(self) -> int:
        """The last keyframe from which anything was seen; the first one where nothing ever was."""
        for number in reversed(self._sparsifier.held):
            keyframe = self._keyframes[number]
            if keyframe.observations or scan_of(keyframe) is not None:
                return number
        return self._sparsifier.held[0]

    def _measured(self, keyframe: Keyframe, used: Motion) -> Motion | None:
        """The motion that came with a keyframe as the graph has it, errors of calibration still in it; see `_Step`."""
        if keyframe.motion is None or self.odometry_record.steps[-1].used == "not":
            return None
        if self.odometry_record.steps[-1].used == "erring":
            return replace(used, response=None)
        return scaled(keyframe.motion, self.odometry_scale.factor)


def coast(
    a_T_b: FloatArray | None,
    before_s: float,
    ahead_s: float,
    rules: CoastingConfig,
    covariance: FloatArray | None = None,
) -> Motion:
    """The motion of the next `ahead_s` seconds by constant velocity.

    Args:
        a_T_b: Motion of the `before_s` seconds before, shape (4, 4); None: none is known, the body stands.
        before_s, ahead_s: How long that one took and this one takes, s.
        rules: How far velocity may change.
        covariance: Of that motion, SP order along the axes of its end, shape (6, 6): the next errs as it does. None: it
            is known. Along what was seen of no motion for a while velocity is an assumption that grows old.

    Returns:
        A spatial motion, with covariance in SP order. Without a motion before, the speed itself is unknown; with one,
        its change: an acceleration that lasts for the whole step moves the body by its sigma times ahead^2.
    """
    if a_T_b is None or before_s <= 0.0:
        step = np.eye(4)
        sigmas = rules.unknown_motion(ahead_s)
    else:
        step = gtsam.Pose3.Expmap(gtsam.Pose3.Logmap(gtsam.Pose3(a_T_b)) * (ahead_s / before_s)).matrix()
        square = ahead_s**2
        sigmas = rules.acceleration_sigma_m_per_s2 * square, rules.turn_change_sigma_rad_per_s2 * square
    total = np.diag(np.repeat([max(sigmas[0], rules.floor_m) ** 2, max(sigmas[1], rules.floor_rad) ** 2], 3))
    if covariance is not None and before_s > 0.0:
        total = total + (ahead_s / before_s) ** 2 * covariance
    return Motion(step, total, (rules.floor_m, rules.floor_rad, rules.floor_rad))


def _with(motion: Motion, beyond: Motion | None) -> Motion:
    """A motion as it is known without a map: with what its returns say beyond all lines, where they do."""
    if beyond is None:
        return motion
    return replace(motion, covariance=inverted(inverted(motion.covariance) + inverted(beyond.covariance)))
