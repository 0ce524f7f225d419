"""The track of a body with a level laser: its motion by wheels and by matching every scan to the way just seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.special import chdtri

from slam.frontend.information import inverted
from slam.frontend.odometry import Motion, OdometryTrack, difference, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.sensors.log import OdometryReading
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Step:
    """A scan's pose by laser odometry, and how it was come by."""

    stamp_ns: int
    """Time of the scan, ns."""
    pose: FloatArray
    """(x, y, theta) in the frame of the track, shape (3,)."""
    wheels: FloatArray
    """Covariance of the step from the scan before by odometry alone, or by the assumption of constant velocity, in the
    axes of the body there, shape (3, 3)."""
    returns: FloatArray
    """What the returns say of the pose in the local map, in the axes of the body here, shape (3, 3): information."""
    slipped: bool = False
    """Whether the returns found it where the wheels cannot have led."""


class LaserTrack(OdometryTrack):
    """Poses of all scans by laser odometry; a motion's covariance says what wheels and returns know of it each."""

    def __init__(self, steps: Sequence[Step], noise: OdometryNoise, between: Sequence[OdometryReading] = ()) -> None:
        """Readings between the scans, before the first and after the last, are of the same frame."""
        readings = [OdometryReading(step.stamp_ns, planar_transform(*step.pose)) for step in steps]
        super().__init__(sorted((*readings, *between), key=lambda one: one.stamp_ns), noise, can_jump=False)
        self._steps = list(steps)
        self._scan_stamps = np.array([step.stamp_ns for step in steps], dtype=np.int64)

    def motion(self, start_ns: int, end_ns: int) -> Motion:
        """Motion between two times: `covariance` is that of the wheels, `returns_covariance` that of the returns."""
        first, last = self._index(start_ns), self._index(end_ns)
        a_T_b = inverse(self.poses_at([start_ns])[0]) @ self.poses_at([end_ns])[0]
        noise, delta = self.noise, planar_delta(a_T_b)
        floor = np.diag([noise.floor_m**2, noise.floor_m**2, noise.floor_rad**2])
        wheels = self._walked(first, last) + floor
        matched = matched_covariance(self._steps[first], self._steps[last], delta)
        out_of_plane = (noise.z_sigma_m, noise.roll_sigma_rad, noise.pitch_sigma_rad)
        return Motion(a_T_b, wheels, out_of_plane, returns_a_T_b=a_T_b, returns_covariance=0.5 * (matched + matched.T))

    def slipped(self, start_ns: int, end_ns: int) -> bool:
        """Whether wheels slipped on a step after one time and up to another."""
        return any(step.slipped for step in self._steps[self._index(start_ns) + 1 : self._index(end_ns) + 1])

    def _index(self, stamp_ns: int) -> int:
        """The last scan not later than a time."""
        return int(np.clip(np.searchsorted(self._scan_stamps, stamp_ns, side="right") - 1, 0, len(self._steps) - 1))

    def _walked(self, first: int, last: int) -> FloatArray:
        """Covariance of (x, y, theta) from one scan to a later one by wheels alone, in the axes of the first."""
        total, base = np.zeros((3, 3)), self._steps[first].pose
        end = between(base, self._steps[last].pose)
        for index in range(first + 1, last + 1):
            turn = self._steps[index - 1].pose[2] - base[2]
            here = between(base, self._steps[index].pose)
            carry = rotation(turn)
            carry[:2, 2] = -(end - here)[1], (end - here)[0]
            total += carry @ self._steps[index].wheels @ carry.T
        return total


def matched_covariance(first: Step, last: Step, delta: FloatArray) -> FloatArray:
    """Covariance (3, 3) of a motion (x, y, theta) between two scans, by the returns of both in the local map."""
    nothing = 1e-3 * np.eye(3)  # 1 / m^2 and 1 / rad^2: as good as no information
    a, b = (inverted(step.returns + nothing) for step in (first, last))
    carry = np.eye(3)
    carry[:2, 2] = -delta[1], delta[0]
    turn = rotation(delta[2])
    return carry @ a @ carry.T + turn @ b @ turn.T


def motion_between(
    track: LaserTrack, wheels: OdometryTrack | None, stamps_ns: tuple[int, int], significance: float
) -> Motion:
    """The motion between two keyframes for the graph: the wheels' own, or where returns refute them the matched one.

    As long as wheels agree with the matched motion they are what was measured, with the noise that was learnt of them
    where it is more than what was stated. Wheels that slip, stand still or are not there measure nothing: then the
    matched motion stands in, as wide as it is without the returns. What these say is kept beside it in both cases.
    `significance` is the probability that honest wheels are refuted.
    """
    matched = track.motion(*stamps_ns)
    measured = None if wheels is None else wheels.motion(*stamps_ns)
    if measured is None or not measured.is_planar or matched.returns_covariance is None:
        return matched
    error = difference(planar_delta(measured.a_T_b), planar_delta(matched.a_T_b))
    spread = measured.covariance + matched.returns_covariance
    if track.slipped(*stamps_ns) or error @ np.linalg.solve(spread, error) > chdtri(3, significance):
        return replace(matched, refuted_a_T_b=measured.a_T_b)
    told = {"returns_a_T_b": matched.a_T_b, "returns_covariance": matched.returns_covariance}
    return replace(measured, covariance=_larger(measured.covariance, matched.covariance), **told)


def _larger(stated: FloatArray, learnt: FloatArray) -> FloatArray:
    """The larger of two covariances in the axes in which both are diagonal."""
    root = np.linalg.cholesky(stated)
    whitened = np.linalg.solve(root, np.linalg.solve(root, learnt).T)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    turned = root @ vectors
    covariance = (turned * np.maximum(values, 1.0)) @ turned.T
    return 0.5 * (covariance + covariance.T)


def between_scans(steps: Sequence[Step], wheels: OdometryTrack | None) -> list[OdometryReading]:
    """Poses at the times of the wheels' readings but those of scans, in the frame of the matched poses.

    Between two scans the wheels, made to meet both, err as a bridge of their random walk: with the variance s (1 - s)
    times that of the step at its share s. Going on evenly errs by s (1 - s) / 2 of what a change of velocity makes of
    the step, and by how much the velocity changes the steps before and after tell. The two are weighed by that, for the
    place and for the heading. Before the first scan and after the last there are the wheels alone; without any the body
    goes on there as in the step beside, for as long as that took.
    """
    if not wheels:
        return _going_on(steps)
    stamps = np.array([step.stamp_ns for step in steps], dtype=np.int64)
    at_scans, readings = wheels.poses_at(stamps.tolist()), wheels.readings
    times = np.array([one.stamp_ns for one in readings], dtype=np.int64)
    others = np.flatnonzero(~np.isin(times, stamps))
    uneven = _unevenness(steps)
    found = []
    for number, after in zip(others.tolist(), np.searchsorted(stamps, times[others]).tolist(), strict=True):
        before = max(after - 1, 0)
        pose = compose(steps[before].pose, planar_delta(inverse(at_scans[before]) @ readings[number].odom_T_body))
        if 0 < after < len(steps):
            led = compose(steps[before].pose, planar_delta(inverse(at_scans[before]) @ at_scans[after]))
            share = float(times[number] - stamps[before]) / float(stamps[after] - stamps[before])
            by_wheels = pose + share * difference(steps[after].pose, led)
            evenly = steps[before].pose + share * difference(steps[after].pose, steps[before].pose)
            weight = _weight_of_wheels(share, steps[after].wheels, uneven[after])
            pose = evenly + weight * difference(by_wheels, evenly)
        found.append(OdometryReading(int(times[number]), planar_transform(*pose)))
    return found


def _going_on(steps: Sequence[Step]) -> list[OdometryReading]:
    """A step more at both ends: other sensors look before the first scan and after the last."""
    ends = [(steps[1], steps[0]), (steps[-2], steps[-1])] if len(steps) > 1 else []
    poses = [compose(b.pose, between(a.pose, b.pose)) for a, b in ends]
    return [
        OdometryReading(2 * b.stamp_ns - a.stamp_ns, planar_transform(*pose))
        for (a, b), pose in zip(ends, poses, strict=True)
    ]


def _unevenness(steps: Sequence[Step]) -> FloatArray:
    """How much further each step (x, y, theta) would be with the velocity after it than with that before, (N, 3)."""
    moved = np.array([np.zeros(3), *(between(a.pose, b.pose) for a, b in pairwise(steps))])
    seconds = 1e-9 * np.diff([step.stamp_ns for step in steps], prepend=steps[0].stamp_ns - 1)
    velocities = moved / seconds[:, None]
    numbers, last = np.arange(len(steps)), len(steps) - 1
    changes = velocities[np.minimum(numbers + 1, last)] - velocities[np.clip(numbers - 1, 1, last)]
    return np.asarray(np.abs(changes) * seconds[:, None], dtype=np.float64)


def _weight_of_wheels(share: float, step: FloatArray, uneven: FloatArray) -> FloatArray:
    """What part of (x, y, theta) the wheels tell at a share of a step whose covariance they have, shape (3,)."""
    bridge = share * (1.0 - share)
    by_wheels = bridge * np.array([0.5 * np.trace(step[:2, :2])] * 2 + [step[2, 2]])
    place = float(np.hypot(*uneven[:2]))
    evenly = np.square(0.5 * bridge * np.array([place, place, uneven[2]]))
    return np.asarray(evenly / np.maximum(evenly + by_wheels, 1e-300), dtype=np.float64)


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Pose b (x, y, theta) in the frame of a."""
    c, s = np.cos(a[2]), np.sin(a[2])
    dx, dy = b[0] - a[0], b[1] - a[1]
    return np.array((c * dx + s * dy, c * dy - s * dx, b[2] - a[2]))


def compose(pose: FloatArray, delta: FloatArray) -> FloatArray:
    """A pose (x, y, theta) moved on by a step in its own axes."""
    return pose + rotation(pose[2]) @ delta


def rotation(angle: float) -> FloatArray:
    """Of (x, y, theta), shape (3, 3)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
