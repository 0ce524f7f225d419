"""How a body moved between two matched scans: by its wheels, and by going on evenly, each as far as it is known."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from slam.frontend.laser_odometry.track import Step, between, compose
from slam.frontend.odometry import OdometryTrack, difference, planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.sensors.log import OdometryReading
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray


def between_scans(steps: Sequence[Step], wheels: Sequence[OdometryReading]) -> list[OdometryReading]:
    """Poses at the times of the wheels' readings but those of scans, in the frame of the matched poses.

    Between two scans the wheels, made to meet both, err as a bridge of their random walk: with the variance s (1 - s)
    times that of the step at its share s. Going on evenly errs by s (1 - s) / 2 of what a change of velocity makes of
    the step, and by how much the velocity changes the steps before and after tell. The two are weighed by that, for the
    place and for the heading. Before the first scan and after the last there are the wheels alone; without any the body
    goes on there as in the step beside, for as long as that took.
    """
    if not steps:
        return []
    if not wheels:
        return _going_on(steps)
    stamps = np.array([step.stamp_ns for step in steps], dtype=np.int64)
    at_scans = OdometryTrack(wheels, OdometryNoise()).poses_at(stamps.tolist())
    times = np.array([one.stamp_ns for one in wheels], dtype=np.int64)
    others = np.flatnonzero(~np.isin(times, stamps))
    uneven = _unevenness(steps)
    found = []
    for number, after in zip(others.tolist(), np.searchsorted(stamps, times[others]).tolist(), strict=True):
        before = max(after - 1, 0)
        pose = compose(steps[before].pose, planar_delta(inverse(at_scans[before]) @ wheels[number].odom_T_body))
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
    found = []
    for end, beside in ((0, 1), (-1, -2)) if len(steps) > 1 else ():
        a, b = steps[beside], steps[end]
        pose = compose(b.pose, between(a.pose, b.pose))
        found.append(OdometryReading(2 * b.stamp_ns - a.stamp_ns, planar_transform(*pose)))
    return found


def _unevenness(steps: Sequence[Step]) -> FloatArray:
    """How much further each step (x, y, theta) would be with the velocity after it than with that before, (N, 3)."""
    moved = np.array([np.zeros(3), *(between(a.pose, b.pose) for a, b in pairwise(steps))])
    seconds = 1e-9 * np.diff([step.stamp_ns for step in steps], prepend=steps[0].stamp_ns - 1)
    velocities = moved / seconds[:, None]
    last = len(steps) - 1
    near = [(min(max(k - 1, 1), last), min(k + 1, last)) for k in range(len(steps))]
    changes = np.array([velocities[after] - velocities[before] for before, after in near])
    return np.asarray(np.abs(changes) * seconds[:, None], dtype=np.float64)


def _weight_of_wheels(share: float, step: FloatArray, uneven: FloatArray) -> FloatArray:
    """What part of (x, y, theta) the wheels tell at a share of a step whose covariance they have, shape (3,)."""
    bridge = share * (1.0 - share)
    by_wheels = bridge * np.array([0.5 * np.trace(step[:2, :2])] * 2 + [step[2, 2]])
    place = float(np.hypot(*uneven[:2]))
    evenly = np.square(0.5 * bridge * np.array([place, place, uneven[2]]))
    return np.asarray(evenly / np.maximum(evenly + by_wheels, 1e-300), dtype=np.float64)
