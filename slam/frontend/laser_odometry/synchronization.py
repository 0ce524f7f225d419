"""Temporal calibration: by how much scans are stamped later than odometry, and whether its readings beside them fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from slam.frontend.information import inverted
from slam.frontend.laser_odometry.local_map import LocalMap, Surface
from slam.frontend.laser_odometry.matching import Expected, match_scan
from slam.frontend.odometry import OdometryTrack, planar_delta
from slam.geometry.frames import evenly, inverse
from slam.sensors.log import LaserScan, OdometryReading
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray

#: Turns from one scan to the next that are looked at, rad: what is less tells little of the time, what is more may be
#: matched wrongly. So many of them at most, spread over the drive, and no verdict from fewer than the least.
_LEAST_TURN_RAD, _MOST_TURN_RAD, _MOST_STEPS, _LEAST_STEPS = 0.03, 0.35, 400, 30
#: Offsets that are tried, s: clocks of one machine are not further apart, and buffers not longer.
_REACH_S, _STEP_S = 0.5, 0.01
#: What is expected of a step beside the wheels, m and rad: too wide to pull the turn that the scans show.
_EXPECTED_M, _EXPECTED_RAD = 0.1, 0.2
#: A turn is taken that the returns know to this, rad, and to which the scan before has this share of the scan.
_KNOWN_RAD, _LEAST_FIT = 0.01, 0.6
#: No match of two scans tells a turn better than this, rad.
_RESOLUTION_RAD = 1e-3
#: Probability that either half of the turns speaks by chance for an offset, or for a part of the readings.
_SIGNIFICANCE = 1e-3


class ClockOffset(NamedTuple):
    """How the stamps of scans and of odometry differ."""

    offset_s: float
    """By how much the stamps of scans are later than those of odometry, s."""
    stale: int
    """Readings of odometry that are stamped like a scan, and older than that."""

    @property
    def sentence(self) -> str:
        """What somebody should know."""
        parts = []
        if self.offset_s:
            later = "later" if self.offset_s > 0.0 else "earlier"
            parts.append(f"scans are stamped {abs(self.offset_s):.2f} s {later} than the odometry that goes with them")
        if self.stale:
            parts.append(f"the odometry of {self.stale} readings stamped like a scan is that of another time")
        return " and ".join(parts) + "; nothing was changed for it"


class _Heading(NamedTuple):
    """The heading by odometry in time."""

    stamps_ns: FloatArray
    """Shape (N,), ns."""
    angles: FloatArray
    """Not wrapped, shape (N,), rad."""

    @classmethod
    def of(cls, readings: Sequence[OdometryReading]) -> _Heading:
        """Of readings in time order."""
        angles = [planar_delta(reading.odom_T_body)[2] for reading in readings]
        return cls(np.array([reading.stamp_ns for reading in readings], dtype=np.float64), np.unwrap(angles))

    def turned(self, turns: Sequence[_Turn], early_s: float) -> FloatArray:
        """What was turned over each of N turns, read so much earlier, shape (N,), rad."""
        times = np.array([(turn.start_ns, turn.end_ns) for turn in turns], dtype=np.float64).T - early_s * 1e9
        start, end = np.interp(times, self.stamps_ns, self.angles)
        return end - start


class _Turn(NamedTuple):
    """What two scans tell of a turn."""

    start_ns: int
    end_ns: int
    angle: float
    """By the returns, rad."""


def clock_offset(
    readings: Sequence[OdometryReading],
    scans: Sequence[LaserScan],
    surface: Callable[[LaserScan], Surface],
    noise: OdometryNoise,
) -> ClockOffset | None:
    """By how much scans and odometry are stamped apart, as turns tell it; None: they tell of nothing.

    Turns from one scan to the next are measured by matching, and compared with those by odometry read earlier or later
    by an offset. The offset is the one of largest likelihood, of errors that are Laplace's with a width that is found
    along with it. Only readings with stamps of their own tell of time: some logs hold, with each scan, a copy of one
    that is as old as it is, whatever its stamp. What holds for half of the turns has to hold for the other half.

    Args:
        readings: of odometry, in time order.
        scans: of level lasers, in time order.
        surface: of a scan, in the body frame.
        noise: of the wheels.

    References:
        Olson, "A passive solution to the sensor synchronization problem", IROS 2010; Furgale, Rehder and Siegwart,
        "Unified temporal and spatial calibration for multi-sensor systems", IROS 2013.
    """
    at_scans = {scan.stamp_ns for scan in scans}
    between = [reading for reading in readings if reading.stamp_ns not in at_scans]
    if len(between) < _LEAST_STEPS:  # stamped with the scans: of any other time it tells nothing
        return None
    turns = _turns(OdometryTrack(readings, noise), scans, surface)
    if len(turns) < _LEAST_STEPS:
        return None
    whole, fresh = _Heading.of(readings), _Heading.of(between)
    least, halves = chdtri(1, _SIGNIFICANCE) / 2.0, (turns[::2], turns[1::2])
    for learnt, other in (halves, halves[::-1]):
        offset_s = _likeliest(fresh, learnt)
        if _log_likelihood(fresh, other, offset_s) - _log_likelihood(whole, other, 0.0) < least:
            return None
    offset_s = _likeliest(fresh, turns)
    gained = _log_likelihood(fresh, turns, offset_s) - _log_likelihood(whole, turns, offset_s)
    return ClockOffset(offset_s, len(readings) - len(between) if gained >= least else 0)


def _turns(track: OdometryTrack, scans: Sequence[LaserScan], surface: Callable[[LaserScan], Surface]) -> list[_Turn]:
    """Turns that pairs of scans tell well."""
    poses = track.poses_at([scan.stamp_ns for scan in scans])
    steps = np.array([planar_delta(inverse(a) @ b) for a, b in pairwise(poses)]).reshape(-1, 3)
    (wide,) = np.nonzero((np.abs(steps[:, 2]) > _LEAST_TURN_RAD) & (np.abs(steps[:, 2]) < _MOST_TURN_RAD))
    found = []
    for k in wide[evenly(len(wide), _MOST_STEPS)].tolist():
        angle = _turn(surface(scans[k]), surface(scans[k + 1]), steps[k])
        if angle is not None:
            found.append(_Turn(scans[k].stamp_ns, scans[k + 1].stamp_ns, angle))
    return found


def _turn(first: Surface, second: Surface, wheels: FloatArray) -> float | None:
    """The turn between two scans by their returns, rad; None where these do not tell it."""
    if len(first) < 3 or len(second) < 3:
        return None
    covariance = np.diag(np.square((_EXPECTED_M, _EXPECTED_M, _EXPECTED_RAD)))
    match = match_scan(second, LocalMap.of([first], [np.zeros(3)]), [Expected(wheels, covariance, 1.0)], _LEAST_FIT)
    sigma = np.sqrt(inverted(match.information + inverted(covariance))[2, 2] + match.spread[2, 2])
    return float(match.pose[2]) if match.fit >= _LEAST_FIT and sigma < _KNOWN_RAD else None


def _likeliest(heading: _Heading, turns: Sequence[_Turn]) -> float:
    """By how much earlier odometry is read, s, where it tells the turns best."""
    steps = round(_REACH_S / _STEP_S)
    offsets = [_STEP_S * step for step in sorted(range(-steps, steps + 1), key=abs)]
    return max(offsets, key=lambda offset_s: _log_likelihood(heading, turns, offset_s))


def _log_likelihood(heading: _Heading, turns: Sequence[_Turn], offset_s: float) -> float:
    """Of the turns, of odometry read so much earlier, with the likeliest scale of its turns and width of Laplace's."""
    wheels, seen = heading.turned(turns, offset_s), np.array([turn.angle for turn in turns])
    errors = np.abs(seen - _scale(wheels, seen) * wheels)
    return -len(turns) * float(np.log(np.mean(errors) + _RESOLUTION_RAD))


def _scale(wheels: FloatArray, seen: FloatArray) -> float:
    """The factor on turns (N,) that leaves least absolute errors: the weighted median of the ratios."""
    moved = np.abs(wheels) > 0.0
    if not moved.any():
        return 1.0
    ratios, weights = seen[moved] / wheels[moved], np.abs(wheels[moved])
    order = np.argsort(ratios)
    half = np.searchsorted(np.cumsum(weights[order]), 0.5 * weights.sum())
    return float(ratios[order][half])
