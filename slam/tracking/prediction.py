"""The first step of a keyframe: its pose enters the graph by its motion alone, before anything is looked at."""

from __future__ import annotations

from typing import Any, NamedTuple

import gtsam
import numpy as np

from factors import pose_prior
from slam.backend.estimator import pose_symbol
from slam.backend.joint_covariance import motion_covariance
from slam.frontend.keyframes import Keyframe
from slam.frontend.odometry import Motion
from slam.frontend.wheel_calibration import WheelCalibration
from slam.geometry.frames import inverse
from slam.map.sparsification import Link
from slam.map.state import Parts
from slam.registration.relocalization import FoundPlace, found_place, is_wide
from slam.tracking.constant_velocity import coast
from spplanes._check import FloatArray


class StartPose(NamedTuple):
    """Where a run starts, as somebody knew it before."""

    world_T_body: FloatArray
    """Shape (4, 4)."""
    covariance: FloatArray
    """Shape (6, 6), in the SP order (x, y, z, phi, theta, psi), composed on the right."""


class Prediction:
    """Odometry less what has been learnt of the wheels; without any the motion before, or that which the planes tell.

    The last stands in for the wide motion that is known, while observations are matched and no longer: it is made of
    what they will say.
    """

    def __init__(self, parts: Parts, start: StartPose | None) -> None:
        self._keyframes, self._landmarks, self._backend = parts.keyframes, parts.landmarks, parts.backend
        self._thinning, self._config, self._known_start = parts.thinning, parts.config, start
        self.calibration = WheelCalibration()
        self.motion: Motion | None = None
        """The predicted motion to the newest keyframe; None for the first."""
        self.waiting: list[gtsam.NonlinearFactor] = []
        """Factors of the wide motion that another one stands in for."""
        self.standing_in: list[int] = []
        """Indices of the factors of that other one."""
        self.found: FoundPlace | None = None
        """Where the planes found the newest keyframe, if they were asked and could say."""

    @property
    def is_wide(self) -> bool:
        """Whether so little was known of the newest motion that the planes were asked."""
        return self.motion is not None and is_wide(self.motion)

    @property
    def robust(self) -> str | None:
        """Robust kernel on what is matched from here: of a place that the planes had to find some of it is wrong."""
        return (self._config.coasting.robust if self.standing_in else None) or self._config.backend.robust

    def enter(self, keyframe: Keyframe) -> int:
        """Put the pose of a new keyframe into the graph, where others may leave it; returns its key."""
        index = len(self._keyframes)
        key, initial = pose_symbol(index), gtsam.Values()
        guess, factors = self._start(keyframe, key) if index == 0 else self._step(keyframe, index)
        initial.insert(key, gtsam.Pose3(guess))
        room = self._thinning.make_room(index)
        through = [self._through(*motion) for motion in room.motions]
        indices = self._backend.update([*factors, *through], initial, remove=room.stale)
        own = indices[: len(factors)]
        self._thinning.made_room(room, indices[len(factors) :])
        self.standing_in = own if self.waiting else []
        measured = None if self.waiting or index == 0 else keyframe.motion
        self._thinning.entered(index, None if measured is None else Link(measured, own[:1], own[1:]))
        return key

    def confirmed(self) -> None:
        """The wide motion is in the graph, what stood in for it is out."""
        self.waiting, self.standing_in = [], []

    def learn(self) -> None:
        """What the last motion, now that its end has been seen, says about the wheels."""
        if self.motion is None or self.motion.response is None or self.calibration.covariance is None:
            return
        keys = [pose_symbol(len(self._keyframes) - 2), pose_symbol(len(self._keyframes) - 1)]
        a_T_b = inverse(self._backend.pose(keys[0])) @ self._backend.pose(keys[1])
        covariance = motion_covariance(a_T_b, self._backend.joint_covariance(keys).of(keys))
        self.calibration.learn(self.motion, a_T_b, covariance)

    def _start(self, keyframe: Keyframe, key: int) -> tuple[FloatArray, list[Any]]:
        """Where the first keyframe is, and its prior."""
        guess = np.eye(4) if keyframe.world_T_body_guess is None else keyframe.world_T_body_guess
        settings = self._config.backend
        covariance = np.diag(np.repeat([settings.prior_sigma_m, settings.prior_sigma_rad], 3) ** 2)
        if self._known_start is not None:
            guess, covariance = self._known_start
        return guess, [pose_prior(key, guess, covariance)]

    def _step(self, keyframe: Keyframe, index: int) -> tuple[FloatArray, list[Any]]:
        """Where the motion to a keyframe leads, and its factors."""
        before, key = pose_symbol(index - 1), pose_symbol(index)
        world_T_before = self._backend.pose(before)
        motion = self.motion = self._motion_to(keyframe)
        self.found = found_place(keyframe, index, motion, world_T_before, self._landmarks) if is_wide(motion) else None
        if self.found is None:
            return world_T_before @ motion.a_T_b, motion.factors(before, key)
        self.waiting, there = motion.factors(before, key), self.found.motion
        return world_T_before @ there.a_T_b, there.factors(before, key)

    def _motion_to(self, keyframe: Keyframe) -> Motion:
        """Odometry, less what is known to be wrong with it; without any the motion before goes on."""
        if keyframe.motion is not None:
            return self.calibration.predict(keyframe.motion)
        last, stamps = len(self._keyframes) - 1, [frame.stamp_ns * 1e-9 for frame in self._keyframes[-2:]]
        ahead_s = keyframe.stamp_ns * 1e-9 - stamps[-1]
        if last == 0:
            return coast(None, 0.0, ahead_s, self._config.coasting)
        step = inverse(self._backend.pose(pose_symbol(last - 1))) @ self._backend.pose(pose_symbol(last))
        return coast(step, stamps[1] - stamps[0], ahead_s, self._config.coasting)

    def _through(self, first: int, last: int, motion: Motion) -> Any:
        """The factor of a motion as measured through keyframes that have left."""
        return self.calibration.corrected(motion).factors(pose_symbol(first), pose_symbol(last))[0]
