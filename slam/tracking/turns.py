"""Turns of a spinning lidar that nobody compensated for motion: found in what its clouds show.

A cloud is a turn of the lidar, and the body moves on meanwhile: at 1 m/s and ten turns a second what is seen first and
last is 10 cm off what is seen between. A map of such clouds is bent, and no covariance says how. How long a turn takes
need not be told: where a body moves in more than one way, clouds of one place agree when each direction was seen at its
own moment, and not before.

The surface elements of a cloud are laid on those of clouds before by point to plane, and the time at which every
sixteenth of the turn was seen is a variable beside the pose. The turn is the sawtooth that explains most. Where it
begins and which way it goes the order of the points says, or the same data. A trajectory by bent clouds is bent as
well, so that this only tells about how long a turn takes; the map says which of those that there are it is.

References:
    Moosmann, Stiller, "Velodyne SLAM", IV 2011.
    Vizzo et al., "KISS-ICP: in defense of point-to-point ICP", RA-L 2023, for constant velocity within a turn.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.special import chdtri

from slam.frontend.deskewing import Sweeps
from slam.frontend.keyframes import Keyframe
from slam.frontend.measurement import loose_surfaces
from slam.frontend.odometry import OdometryTrack
from slam.frontend.scan_surfaces import ON_EDGE, moved, moved_on, velocities
from slam.geometry.frames import inverse
from slam.io.trajectories import Trajectory
from slam.registration.surface_registration import Correspondences, Expected, LocalMap, Residuals, closeness
from slam.registration.visibility import Scan
from slam.sensors.log import CloudScan, OdometryReading
from slam.sensors.rig import Sensor
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray
from spplanes.clouds.turn import TurnBegin

#: Parts of a turn with a time of their own, steps in each, and places where one may begin.
_PARTS, _WITHIN, _STARTS = 16, 16, 256
#: Keyframes that are laid on others, and that are asked first, and how many before them those are.
_KEYFRAMES, _SUSPICIOUS, _BEFORE = 16, 8, (1, 3, 6)
#: Changes of the turning rate count as much as they move what is so far away, m.
_LEVER = np.array([5.0, 5.0, 5.0, 1.0, 1.0, 1.0])
#: How far, in widths, partners are looked for, the steps of a descent at most, and what ends it, rad and m.
_REACHES, _STEPS, _LAID = (1.5, 1.0), 6, 1e-4
#: Clouds that were compensated show a turn by chance this often, and are looked at closer this often.
TURN_SIGNIFICANCE, _SUSPECT = 1e-6, 1e-2
#: A map of bent clouds has one in the frame of those just before it as well as this: information, of rad and m.
_AS_MAPPED = np.diag(np.repeat([0.01, 0.03], 3) ** -2.0)
#: Elements follow a turn that is found until what is left of it is such a share; and so many times at most.
_CONVERGED, _LOOKS = 0.03, 6
#: Lidars turn 20, 10 or 5 times a second, s.
_USUAL_S = (0.05, 0.1, 0.2)
#: A body moves on evenly for so long, ns.
_ABOUT_NS = 100_000_000
#: Columns of elements with their part of the turn and their velocity.
_PART, _VELOCITY = 9, slice(10, 13)


class Turn(NamedTuple):
    """How a lidar turns, by its clouds."""

    seconds: float = 0.0
    """Time of a turn, s; below nought: it goes the other way than shares of it are counted."""
    start: float = 0.0
    """Share of it at which one begins."""

    def times(self, shares: FloatArray) -> FloatArray:
        """When what is at shares (N,) of the turn was seen, after its middle, (N,), s."""
        return self.seconds * (np.mod(shares - self.start, 1.0) - 0.5)

    def by_part(self) -> FloatArray:
        """The same of the parts of a turn, in the mean, shape (P,), s."""
        shares = (np.arange(_WITHIN * _PARTS) + 0.5) / (_WITHIN * _PARTS)
        return self.times(shares).reshape(_PARTS, _WITHIN).mean(axis=1)

    def usual(self) -> Turn:
        """The turn nearest to this one that lidars take."""
        seconds = min(_USUAL_S, key=lambda one: abs(np.log(one / max(abs(self.seconds), 1e-9))))
        return self._replace(seconds=float(np.copysign(seconds, self.seconds)))

    def state(self, sensor: Sensor) -> Sensor:
        """The sensor that takes such a turn, of which shares are counted from -x on."""
        told = {
            "sweep_s": abs(self.seconds),
            "sweep_start_deg": 360.0 * self.start - 180.0,
            "sweep_clockwise": self.seconds < 0.0,
        }
        return sensor.model_copy(update=told)


def sweeps_along(trajectory: Trajectory) -> Sweeps:
    """How a body moves about each of its poses, three at least: evenly, as from the pose before to the one after.

    It errs by what the rates at poses beside each other differ from an even change of speed.
    """
    poses, gaps = trajectory.poses, np.diff(trajectory.stamps_ns)
    steps = [gtsam.Pose3.Logmap(gtsam.Pose3(step)) for step in np.linalg.inv(poses[:-1]) @ poses[1:]]
    between = np.array(steps) / (1e-9 * gaps[:, None])
    rates = np.concatenate((between[:1], 0.5 * (between[:-1] + between[1:]), between[-1:]))
    near = np.minimum(0.49 * gaps, _ABOUT_NS).astype(np.int64)
    near = np.concatenate((near[:1], np.minimum(near[:-1], near[1:]), near[-1:])).tolist()
    readings = [
        OdometryReading(stamp + to, pose @ gtsam.Pose3.Expmap(1e-9 * to * rate).matrix())
        for stamp, pose, rate, off in zip(trajectory.stamps_ns.tolist(), poses, rates, near, strict=True)
        for to in (-off, 0, off)
    ]
    off_even = rates[1:-1] - 0.5 * (rates[:-2] + rates[2:])
    track = OdometryTrack(readings, OdometryNoise(), can_jump=False)
    return Sweeps(track, off_even.T @ off_even / len(off_even))


def sweeps_of(trajectory: Trajectory, sensors: Iterable[Sensor]) -> Sweeps | None:
    """How a body moves about its poses, for sensors that take time over a turn; None: none does, there are fewer than
    three poses, or their times do not ascend.
    """
    if len(trajectory.stamps_ns) < 3 or not any(sensor.kind == "cloud" and sensor.sweep_s > 0.0 for sensor in sensors):
        return None
    return sweeps_along(trajectory) if (np.diff(trajectory.stamps_ns) > 0).all() else None


def timed(elements: FloatArray, sensor: Sensor, begin: TurnBegin) -> tuple[FloatArray, FloatArray]:
    """Of elements (N, 9) in the body frame those on surfaces, and the share of the turn at which each was seen.

    Edges tell nothing: many are those of the view.
    """
    own = elements[elements[:, 7] != ON_EDGE]
    return own, begin.turned(moved(own, inverse(sensor.body_T_sensor))[:, :3])


class TurnSearch:
    """The turn that clouds of a lidar show along a trajectory."""

    def __init__(
        self,
        sensor: Sensor,
        keyframes: Sequence[Keyframe],
        track: OdometryTrack,
        clouds: Mapping[int, CloudScan] | None = None,
    ) -> None:
        """Of a sensor, what keyframes saw with it, how the body moves, and its clouds by their times, ns: without them
        there may be a turn, and no more is said. Those keyframes are asked between which the motion changes most.
        """
        own = [k for k, frame in enumerate(keyframes) if frame.surfaces is not None]
        own = own if clouds is None else [k for k in own if keyframes[k].stamp_ns in clouds]
        groups = [[own[i], *(own[i - back] for back in _BEFORE if back <= i)] for i in range(1, len(own))]
        # where a body moves evenly all clouds are bent alike
        twists = _twists(track, [frame.stamp_ns for frame in keyframes]) * _LEVER
        changes = [np.linalg.norm(twists[group[1:]] - twists[group[0]], axis=1).max() for group in groups]
        #: Keyframes that are laid on others, first in each, and those, the most telling ones last.
        self._groups = [groups[i] for i in np.argsort(changes, kind="stable")[-_KEYFRAMES:].tolist()]
        self._sensor, self._clouds, self._keyframes = sensor, clouds or {}, keyframes

    def is_suspected(self, trajectory: Trajectory, track: OdometryTrack, significance: float = _SUSPECT) -> bool:
        """Whether there may be a turn: what is on planes lies as these do, which it bends; that costs little to ask."""
        groups = self._groups[-_SUSPICIOUS:]
        seen = {k: (self._keyframes[k].surfaces, TurnBegin()) for group in groups for k in group}
        _, gain = _look(self._views(groups, seen, trajectory, track), Turn(), ordered=False)
        return 2.0 * gain > chdtri(2, significance)

    def turn(self, trajectory: Trajectory, track: OdometryTrack) -> Turn | None:
        """The turn that the returns show as they come; None: they show none."""
        views, turn = self._views(self._groups, self._as_they_come, trajectory, track), Turn()
        for look in range(_LOOKS):
            before, (turn, gain) = turn, _look(views, turn, ordered=self._are_ordered)
            if not look and 2.0 * gain <= chdtri(2, TURN_SIGNIFICANCE):
                return None
            if np.abs(turn.by_part() - before.by_part()).max() < _CONVERGED * abs(turn.seconds):
                break
        return turn

    def left(self, turn: Turn, keyframes: Sequence[Keyframe], trajectory: Trajectory, track: OdometryTrack) -> float:
        """Seconds of a turn that are in what keyframes saw when their clouds were taken as of that turn."""
        groups = self._groups[-_SUSPICIOUS:]
        seen = {k: (keyframes[k].surfaces, self._as_they_come[k][1]) for group in groups for k in group}
        information, told = _told_by_all(self._views(groups, seen, trajectory, track), Turn())
        once = Turn(1.0, turn.start).by_part()
        return float(once @ told / max(float(once @ information @ once), 1e-9))

    def agreement(self, turn: Turn, trajectory: Trajectory, track: OdometryTrack) -> float:
        """How close clouds come to others with a turn, 0 to 1, in the mean of their elements."""
        laid = [_laid(views, turn) for views in self._views(self._groups, self._as_they_come, trajectory, track)]
        close = [closeness(residuals.off, own[residuals.index]).sum() / len(own) for own, _, _, residuals in laid]
        return float(np.mean(close)) if close else 0.0

    @property
    def _numbers(self) -> list[int]:
        return sorted({k for group in self._groups for k in group})

    @cached_property
    def _begins(self) -> dict[int, TurnBegin | None]:
        return {k: self._clouds[self._keyframes[k].stamp_ns].begin for k in self._numbers}

    @property
    def _are_ordered(self) -> bool:
        """Whether points come in the order in which they were seen."""
        return all(begin is not None for begin in self._begins.values())

    @cached_property
    def _as_they_come(self) -> dict[int, tuple[FloatArray, TurnBegin]]:
        """Elements of the clouds that no plane moved, and where their turns begin."""
        clouds = {k: self._clouds[self._keyframes[k].stamp_ns] for k in self._numbers}
        begins = {k: begin if self._are_ordered else None for k, begin in self._begins.items()}
        return {k: (loose_surfaces(cloud, self._sensor), begins[k] or TurnBegin()) for k, cloud in clouds.items()}

    def _views(
        self,
        groups: Sequence[Sequence[int]],
        seen: Mapping[int, tuple[FloatArray | None, TurnBegin]],
        trajectory: Trajectory,
        track: OdometryTrack,
    ) -> list[list[_View]]:
        """Each that is laid on others, first, and those."""
        views, numbers = {}, list(seen)
        twists = _twists(track, [self._keyframes[k].stamp_ns for k in numbers])
        for k, twist in zip(numbers, twists, strict=True):
            elements, begin = seen[k]
            own, shares = timed(np.empty((0, 9)) if elements is None else elements, self._sensor, begin)
            if len(own):
                views[k] = _View(own, shares, trajectory.poses[k], twist)
        found = [[views[k] for k in group if k in views] for group in groups if group[0] in views]
        return [group for group in found if len(group) > 1]


def _twists(track: OdometryTrack, stamps_ns: Sequence[int]) -> FloatArray:
    """How a body moves at some times, in its own frame, GTSAM order (rotation, translation) a second, shape (K, 6)."""
    before, after = (track.poses_at([stamp + off for stamp in stamps_ns]) for off in (-_ABOUT_NS // 2, _ABOUT_NS // 2))
    steps = np.linalg.inv(before) @ after
    return np.array([gtsam.Pose3.Logmap(gtsam.Pose3(step)) for step in steps]).reshape(-1, 6) / (1e-9 * _ABOUT_NS)


class _View(NamedTuple):
    """What a keyframe saw, and how it moved meanwhile."""

    elements: FloatArray
    """In the body frame, as the cloud has them, shape (N, 9)."""
    shares: FloatArray
    """Of the turn at which they are, shape (N,)."""
    world_T_body: FloatArray
    """Shape (4, 4)."""
    twist: FloatArray
    """Of the body in its own frame, (rotation, translation) a second, shape (6,)."""

    def unswept(self, turn: Turn, known_T_body: FloatArray) -> FloatArray:
        """The elements as if they had been seen at once, in another frame, with their part of the turn and the velocity
        of the body where they are, shape (N, 13).
        """
        elements = moved_on(self.elements, turn.times(self.shares), self.twist)
        ahead = velocities(self.elements[:, :3], self.twist) @ known_T_body[:3, :3].T
        part = np.mod(np.floor(self.shares * _PARTS), _PARTS)
        return moved(np.column_stack((elements, part, ahead)), known_T_body)


def _laid(views: Sequence[_View], turn: Turn) -> tuple[FloatArray, LocalMap, FloatArray, Residuals]:
    """The first of some views laid on the others with a turn: its elements (N, 13), theirs, its motion from where it
    was (4, 4), and what is left.
    """
    poses = [inverse(views[0].world_T_body) @ view.world_T_body for view in views[1:]]
    parts = [Scan(view.unswept(turn, pose), np.zeros(3)) for view, pose in zip(views[1:], poses, strict=True)]
    known, own = LocalMap([(np.eye(4), part) for part in parts]), views[0].unswept(turn, np.eye(4))
    pairs, motion = Correspondences(own, known), np.eye(4)
    for reach in _REACHES:
        for _ in range(_STEPS):
            residuals = Residuals.of(pairs, motion, reach * pairs.widths)
            step = residuals.step(motion, Expected(np.eye(4), _AS_MAPPED))
            motion = motion @ gtsam.Pose3.Expmap(step).matrix()
            if np.abs(step).max() < _LAID:
                break
    return own, known, motion, Residuals.of(pairs, motion, _REACHES[-1] * pairs.widths)


def _look(groups: Sequence[Sequence[_View]], turn: Turn, *, ordered: bool) -> tuple[Turn, float]:
    """The turn that explains most of what one leaves, and half the chi2 that it takes away; none, if not all is seen.

    Of `ordered` points it begins at nought.
    """
    information, told = _told_by_all(groups, turn)
    if np.count_nonzero(np.diag(information)) < _PARTS:
        return turn, 0.0
    best, most, taken = turn, 0.0, turn.by_part()
    for start in [0.0] if ordered else np.linspace(0.0, 1.0, _STARTS, endpoint=False).tolist():
        once = Turn(1.0, start).by_part()
        seconds = float(once @ (told + information @ taken) / (once @ information @ once))
        if ordered and seconds < 0.0:
            continue  # time does not run backwards
        more = seconds * once - taken
        gain = float(more @ told - 0.5 * more @ information @ more)
        if gain > most:
            best, most = Turn(seconds, start), gain
    return best, most


def _told_by_all(groups: Sequence[Sequence[_View]], turn: Turn) -> tuple[FloatArray, FloatArray]:
    """What all groups say of the times of the parts of a turn beyond those it has, as `_told`."""
    information, told = np.zeros((_PARTS, _PARTS)), np.zeros(_PARTS)
    for views in groups:
        by_one, of_one = _told(*_laid(views, turn))
        information, told = information + by_one, told + of_one
    return information, told


def _told(own: FloatArray, known: LocalMap, motion: FloatArray, residuals: Residuals) -> tuple[FloatArray, FloatArray]:
    """What a view laid on others says of the times of the parts of a turn beyond those it has, wherever it is:
    information (P, P), and that times the times (P,).
    """
    mine, theirs = own[residuals.index], known.elements[residuals.partners]
    by_time, every = np.zeros((len(mine), _PARTS)), np.arange(len(mine))
    ahead = mine[:, _VELOCITY] @ motion[:3, :3].T
    by_time[every, mine[:, _PART].astype(int)] = np.einsum("ni,ni->n", theirs[:, 3:6], ahead)
    by_time[every, theirs[:, _PART].astype(int)] -= np.einsum("ni,ni->n", theirs[:, 3:6], theirs[:, _VELOCITY])
    design = np.column_stack((residuals.jacobian, by_time))
    weighed = residuals.weights[:, None] * design
    normal, gradient = design.T @ weighed, -weighed.T @ residuals.off
    by_pose = normal[6:, :6] @ np.linalg.inv(normal[:6, :6] + _AS_MAPPED)
    return normal[6:, 6:] - by_pose @ normal[:6, 6:], gradient[6:] - by_pose @ gradient[:6]
