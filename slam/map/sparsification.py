"""Sparsification: keyframes leave the graph where the map is known, for one more says next to nothing about it."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any, NamedTuple

import gtsam
import numpy as np

from factors._conventions import SP_TO_POSE3
from factors.association.observations import Observation
from slam.backend.elimination import graph_of
from slam.backend.estimator import Backend, pose_symbol, pose_symbols
from slam.backend.joint_covariance import carried
from slam.config import ThinningConfig
from slam.frontend.information import floor_information, information_as_seen
from slam.frontend.odometry import Motion
from slam.frontend.wheel_calibration import random_covariance, shared_covariance
from slam.map.landmarks import LandmarkMap
from spplanes._check import FloatArray

#: Covariance of a pose of which nothing is known, m^2 and rad^2.
_UNKNOWN = 1e4 * np.eye(6)


class PoseSupport:
    """Follows how well the newest pose is known in the map by all that was seen, and by the latest part of it alone.

    Along a corridor that part reaches back to the last end wall or door frame; where all directions are seen at once it
    is a keyframe or two. Two Kalman filters of the pose with the map taken as known, without their means.
    """

    def __init__(self) -> None:
        self._by_all = self._by_late = _UNKNOWN
        self._late_from = 0
        self.needed_from = 0
        """What was seen before this keyframe tells nothing of the newest pose that was not seen since."""

    def step(self, keyframe: int, motion: Motion | None, matched: Iterable[Observation]) -> None:
        """A keyframe has come by a motion, None where nobody measured it, and saw known planes."""
        information = sum(map(information_as_seen, matched), start=floor_information(motion))
        self._by_all = _seen(_moved(self._by_all, motion), information)
        self._by_late = _seen(_moved(self._by_late, motion), information)
        root = np.linalg.cholesky(self._by_all)
        whitened = np.linalg.solve(root, np.linalg.solve(root, self._by_late).T)
        if np.linalg.eigvalsh(0.5 * (whitened + whitened.T))[-1] <= 1.2:  # as well, to 10 % of a standard deviation
            self.needed_from, self._late_from = self._late_from, keyframe
            self._by_late = _seen(_UNKNOWN, information)


def _moved(covariance: FloatArray, motion: Motion | None) -> FloatArray:
    if motion is None:
        return _UNKNOWN
    carry = gtsam.Pose3(motion.a_T_b).inverse().AdjointMap()
    return carry @ covariance @ carry.T + motion.spatial[np.ix_(SP_TO_POSE3, SP_TO_POSE3)]


def _seen(covariance: FloatArray, information: FloatArray) -> FloatArray:
    """By a square root: a difference of inverses is not symmetric where much is unknown and much is told."""
    root = np.linalg.cholesky(covariance)
    half = np.linalg.solve(np.linalg.cholesky(np.eye(6) + root.T @ information @ root), root.T)
    return np.asarray(half.T @ half, dtype=np.float64)


class Link(NamedTuple):
    """What ties a keyframe to the one before it in the graph."""

    motion: Motion
    """The motion from there as measured, as wide as it was used."""
    step: list[int]
    """Index of its factor."""
    floor: list[int]
    """Indices of the factors that hold the keyframe to the floor."""


class MeasuredStep(NamedTuple):
    """A motion that wheels measured from a keyframe `before` to another one, and the index of its factor."""

    before: int
    keyframe: int
    motion: Motion
    factor_index: int


class Removal(NamedTuple):
    """What changes in the graph when keyframes leave it."""

    motions: Sequence[tuple[int, int, Motion]] = ()
    """Motions as measured to put in, each from a keyframe to a later one."""
    stale: Sequence[int] = ()
    """Indices of the factors to take out."""


class Sparsifier:
    """Decides which keyframes stay in the graph, and takes the others out of it.

    A place that has been driven through several times is mapped: of a further keyframe there the graph keeps neither
    pose nor measurements, only the odometry through it, once the newest pose is known as well without (`PoseSupport`).
    So the graph is as large as the area it maps, not as the mission is long. Nothing is counted twice: what the
    measurements said of the keyframe's own pose is kept beside the graph, as a place relative to the nearest keyframe
    that stays (`PastPose`); what they said of the map is given away, and it is little: that is what is asked first.

    References:
        Ila, Porta, Andrade-Cetto, "Information-based compact pose SLAM", T-RO 2010, for keeping what informs.
    """

    def __init__(self, config: ThinningConfig, backend: Backend, landmarks: LandmarkMap) -> None:
        self._config, self._backend, self._landmarks = config, backend, landmarks
        self.held: list[int] = []
        self._leaving: set[int] = set()
        self._links: dict[int, Link] = {}
        self._support = PoseSupport()
        #: How many steps wheels have measured, those that have left the graph included.
        self.n_measured = 0

    def entered(self, keyframe: int, link: Link | None) -> None:
        """A keyframe is in the graph; None: by something else than odometry, so it stays, and those before it."""
        self.held.append(keyframe)
        if link is not None:
            self._links[keyframe] = link
            self.n_measured += link.motion.response is not None

    def linked(self, keyframe: int, factor_index: int) -> None:
        """Another factor links a keyframe to the one before it."""
        if keyframe in self._links:
            link = self._links[keyframe]
            self._links[keyframe] = link._replace(step=[*link.step, factor_index])

    def measured_steps(self) -> list[MeasuredStep]:
        """The steps that wheels measured, in order of time."""
        return [
            MeasuredStep(self._before(one), one, link.motion, link.step[0])
            for one, link in sorted(self._links.items(), key=itemgetter(0))
            if link.motion.response is not None and link.step
        ]

    def relinked(self, steps: Sequence[MeasuredStep], factor_indices: Sequence[int]) -> None:
        """The motions of steps have other factors now."""
        for step, index in zip(steps, factor_indices, strict=True):
            link = self._links[step.keyframe]
            self._links[step.keyframe] = link._replace(step=[index, *link.step[1:]])

    def judge(self, keyframe: int, matched: Sequence[Observation], factors: Sequence[Any], *, may_leave: bool) -> bool:
        """Whether a keyframe need not stay: it saw known landmarks, by `factors`, and is of no other use."""
        link = self._links.get(keyframe)
        self._support.step(keyframe, None if link is None else link.motion, matched)
        if not (may_leave and self._config.passes and link and factors and self._is_known_place()):
            return False
        if information_gain(factors, pose_symbol(keyframe), self._backend) > self._config.max_news:
            return False
        self._leaving.add(keyframe)
        return True

    def stays(self, keyframe: int) -> None:
        """A keyframe is needed after all."""
        self._leaving.discard(keyframe)

    def anchor(self, keyframe: int, every: int, since: int) -> int:
        """The keyframe in whose frame landmarks born at a keyframe live: one of every so many, if it stays.

        None before `since`: where it is from those is not known.
        """
        last = max(keyframe - 1, since)
        wanted = last // every * every
        staying = [one for one in self.held[-2 * every :] if since <= one <= wanted and one not in self._leaving]
        return staying[-1] if staying and staying[-1] > wanted - every else last

    def plan_removal(self, keyframe: int) -> Removal:
        """Before a keyframe comes: who goes, the last two excepted."""
        due = sorted(one for one in self._leaving if one < min(self._support.needed_from, keyframe - 1))
        going = due[:4]  # more at once would be a jolt
        self._leaving.difference_update(going)
        going = [one for one in going if self._after(one) in self._links]
        if not going:
            return Removal()
        self._backend.marginalize(self._bases(going))
        stale: list[int] = []
        anew: set[int] = set()
        for one in going:
            after = self._after(one)
            own, link = self._links.pop(one), self._links[after]
            stale += [*own.step, *own.floor, *link.step, *self._landmarks.let_go(one)]
            self._links[after] = Link(chained(own.motion, link.motion), [], link.floor)
            self.held.remove(one)
            anew = anew - {one} | {after}
        return Removal([(self._before(one), one, self._links[one].motion) for one in sorted(anew)], stale)

    def removed(self, removal: Removal, factor_indices: Sequence[int]) -> None:
        """The indices of the factors of the removal's motions."""
        for (_, one, motion), index in zip(removal.motions, factor_indices, strict=True):
            self._links[one] = Link(motion, [index], self._links[one].floor)

    def _before(self, keyframe: int) -> int:
        return self.held[bisect_left(self.held, keyframe) - 1]

    def _after(self, keyframe: int) -> int:
        return self.held[bisect_left(self.held, keyframe) + 1]

    def _bases(self, going: Sequence[int]) -> dict[int, int]:
        """For the keys of those that go, the keys of those nearest to them that stay."""
        staying = [one for one in self.held if one not in self._leaving and one not in going]
        keys = pose_symbols(staying).tolist()
        places = self._backend.poses(keys)[:, :3, 3]
        bases = {}
        for key in map(pose_symbol, going):
            away = np.linalg.norm(places - self._backend.pose(key)[:3, 3], axis=1)
            bases[key] = keys[int(np.argmin(away))]
        return bases

    def _is_known_place(self) -> bool:
        """Whether so many earlier passes have left keyframes about the place of the last one."""
        poses = self._backend.poses(pose_symbols(self.held))
        here = poses[-1]
        near = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1) <= self._config.radius_m
        alike = 0.5 * (np.trace(here[:3, :3].T @ poses[:, :3, :3], axis1=1, axis2=2) - 1.0) >= np.cos(
            self._config.angle_rad
        )
        frames = np.array(self.held)[near & alike]
        return 1 + int((np.diff(frames) > self._config.apart).sum()) > self._config.passes


def information_gain(factors: Sequence[Any], pose_key: int, backend: Backend) -> float:
    """What factors of a pose and known landmarks tell of the landmarks, nats per degree of freedom.

    The mutual information of the measurements and everything but the pose: with A the whitened derivatives, P the joint
    covariance before and X that of the pose when all else is known, it is half of log det(A P A^T + I) less half of
    log det(A_x X A_x^T + I). Of a landmark known as well as n measurements make it, another such tells 1 / (2 n).
    """
    graph = graph_of(factors)
    keys = sorted(graph.keyVector())
    joint = backend.joint_covariance(keys)
    jacobian, _ = graph.linearize(backend.values_of(keys)).jacobian(gtsam.Ordering(keys))
    told, covariance = jacobian[np.abs(jacobian).max(axis=1) > 0.0], joint.of(keys)
    own = np.flatnonzero(np.isin(joint.columns(keys), joint.columns([pose_key])))
    given_rest = np.asarray(np.linalg.inv(np.linalg.inv(covariance)[np.ix_(own, own)]), dtype=np.float64)
    return (_log_det(told, covariance) - _log_det(told[:, own], given_rest)) / (2.0 * len(told))


def _log_det(jacobian: FloatArray, covariance: FloatArray) -> float:
    return float(np.linalg.slogdet(jacobian @ covariance @ jacobian.T + np.eye(len(jacobian)))[1])


def chained(first: Motion, second: Motion) -> Motion:
    """The motion from a to c by those from a to b and from b to c, both as measured, of one kind and one robot.

    To first order. Errors of calibration are the same in both; all others of one are independent of those of the other.
    """
    a_T_c = first.a_T_b @ second.a_T_b
    turn, carry = np.eye(3), np.eye(3)
    turn[:2, :2] = first.a_T_b[:2, :2]
    moved = turn[:2, :2] @ second.a_T_b[:2, 3]
    carry[:2, 2] = -moved[1], moved[0]
    response, own = None, (first.covariance, second.covariance)
    if first.response is not None and second.response is not None:
        response = carry @ first.response + turn @ second.response
        own = random_covariance(first), random_covariance(second)
    if first.is_planar:
        covariance = carry @ own[0] @ carry.T + turn @ own[1] @ turn.T
        out = _out_of_plane(first, second)
    else:
        covariance, out = carried(own[0], second.a_T_b) + own[1], first.out_of_plane_sigmas
    whole = Motion(a_T_c, covariance, out, response, first.calibration_sigmas)
    if response is None:
        return whole
    stated = np.diag(np.square(whole.calibration_sigmas))
    return replace(whole, covariance=covariance + shared_covariance(whole, stated))


def _out_of_plane(first: Motion, second: Motion) -> tuple[float, float, float]:
    """Standard deviations (z, roll, pitch) of both: a tilt of the first lifts the end of the second."""
    lever = float(np.linalg.norm(second.a_T_b[:3, 3]))
    (z, *tilts), (other_z, *others) = first.out_of_plane_sigmas, second.out_of_plane_sigmas
    tilt = max(tilts)
    return (
        float(np.sqrt(z**2 + other_z**2 + (lever * tilt) ** 2)),
        float(np.hypot(tilt, others[0])),
        float(np.hypot(tilt, others[1])),
    )
