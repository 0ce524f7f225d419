"""Wheels that say they stand while a push-broom laser sees the robot drive on: stretches that nobody measured.

A slice says nothing of the motion across it, so that wheels alone place one beside the other. Where they hang, or a
robot is pushed, all that passes by seems to be at one place, and the way is missing from the map. While a robot stands
its slices are alike up to noise, but for people who pass, and are nearer than what they hide: where most of one is
nearer than usual, or some of it farther, it does not stand. Along an even corridor slices are alike as well: until
something else comes by nothing tells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from slam.config import CoastingConfig
from slam.frontend.measurement import usable_ranges
from slam.frontend.odometry import Motion, OdometryTrack
from slam.geometry.frames import are_apart
from slam.sensors.log import LaserScan
from slam.sensors.rig import Sensor

#: Wheels stand that are nearer than this to where they were, m and rad.
STANDING = 1e-3
#: Fewer slices of one place are too few to tell.
_FEW = 5


class Stall(NamedTuple):
    """A stretch of time over which wheels stood and the robot did not."""

    first_ns: int
    """Time of the first slice of one place."""
    last_ns: int
    """Of the last."""

    def overlaps(self, start_ns: int, end_ns: int) -> bool:
        """Whether a motion from a time to a later one goes through it."""
        return start_ns < self.last_ns and self.first_ns < end_ns

    def has(self, scan: LaserScan) -> bool:
        """Whether a scan was made meanwhile."""
        return self.first_ns <= scan.stamp_ns <= self.last_ns


def over_stalls(motion: Motion, seconds: float, rules: CoastingConfig) -> Motion:
    """A motion of wheels that stood for so long, as one that nobody measured: from where they stood to anywhere."""
    place, turn = rules.unknown_motion(seconds)
    anywhere = motion.erring(np.diag(np.repeat([place, min(turn, np.pi)], 3) ** 2))
    return replace(anywhere, response=None, returns_a_T_b=motion.a_T_b)


def stalls_of(scans: Sequence[LaserScan], sensor: Sensor, track: OdometryTrack) -> list[Stall]:
    """Stretches over which the odometry has the robot at one place and the slices of a sensor do not."""
    poses, found, first = track.poses_at([scan.stamp_ns for scan in scans]), [], 0
    for end in range(1, len(scans) + 1):
        if end < len(scans) and not are_apart(poses[first], poses[end], STANDING, STANDING):
            continue
        if end - first >= _FEW and _sees_another_place(scans[first:end], sensor):
            found.append(Stall(scans[first].stamp_ns, scans[end - 1].stamp_ns))
        first = end
    return found


def _sees_another_place(scans: Sequence[LaserScan], sensor: Sensor) -> bool:
    """Whether any of some slices is another than they are as a rule, beam by beam."""
    alike = [scan.ranges for scan in scans if len(scan.ranges) == len(scans[0].ranges)]
    ranges = np.array([usable_ranges(one, sensor) for one in alike])
    told = np.isfinite(ranges)
    ranges, returns = ranges[:, told.any(axis=0)], np.maximum(told.sum(axis=1), 1)
    usual = np.nanmedian(ranges, axis=0)
    least = 6.0 * np.sqrt(sensor.range_variance_at(usual))  # so many, for the rig may state too little
    nearer, farther = ((off > least).sum(axis=1) / returns for off in (usual - ranges, ranges - usual))
    # people hide half of the returns at most; fewer are farther than usual, because somebody who stood there has left
    return bool(np.any((nearer > 0.5) | (farther > 0.15)))
