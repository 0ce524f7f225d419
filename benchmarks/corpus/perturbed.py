"""Real logs made worse in known ways: wheels that slip, err or are not there, noisier lasers, scans or clocks amiss."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import accumulate, pairwise

import numpy as np

from benchmarks.corpus.drives.disturbances import thinned
from slam.frontend.odometry import planar_delta
from slam.geometry.frames import inverse, planar_transform
from slam.io.scan_files import in_order
from slam.sensors.log import LaserScan, Log, OdometryReading
from slam.sensors.rig import Rig
from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS
from spplanes._check import FloatArray

Perturbation = Callable[[Log, Rig, np.random.Generator], Log]

#: Headings, and ranges, err so many times as much as the default rig says.
_WORSE, _NOISIER = 3.0, 2.0
#: One slip in so many metres, by so much, rad.
_SLIP_EVERY_M, _SLIP_RAD = 100.0, float(np.deg2rad(20.0))
#: Odometry is stamped later or earlier by this, s.
_LATE_S = 0.1


def heading3(log: Log, rig: Rig, rng: np.random.Generator) -> Log:
    """Heading noise beside that of the wheels themselves, together three times what the default rig says."""
    noise, share = UNCALIBRATED_WHEELS, np.sqrt(_WORSE**2 - 1.0)

    def sigma(way_m: float, turn_rad: float) -> float:
        by_way, by_turn = noise.heading_sigma_rad_per_sqrt_m**2, noise.heading_sigma_rad_per_sqrt_rad**2
        return float(share * np.sqrt(by_way * way_m + by_turn * abs(turn_rad)))

    deltas = _deltas(log)
    sigmas = np.array([sigma(np.hypot(x, y), turn) for x, y, turn in deltas])
    return _turned(log, deltas, sigmas * rng.normal(size=len(deltas)))


def slips(log: Log, rig: Rig, rng: np.random.Generator) -> Log:
    """A slip to either side once in a hundred metres, at a random place of each."""
    deltas = _deltas(log)
    driven = np.cumsum([np.hypot(x, y) for x, y, _ in deltas])
    turns = np.zeros(len(driven))
    for start in np.arange(0.0, driven[-1], _SLIP_EVERY_M):
        where = int(np.searchsorted(driven, start + rng.uniform(0.0, _SLIP_EVERY_M)))
        if where < len(turns):
            turns[where] += rng.choice([-1.0, 1.0]) * _SLIP_RAD
    return _turned(log, deltas, turns)


def noise2(log: Log, rig: Rig, rng: np.random.Generator) -> Log:
    """Ranges that scatter twice as much as the default rig says."""

    def noisier(scan: LaserScan) -> LaserScan:
        sigma = np.sqrt(_NOISIER**2 - 1.0) * rig.sensors[scan.sensor].range_sigma_m
        return replace(scan, ranges=scan.ranges + sigma * rng.normal(size=len(scan.ranges)))

    return replace(log, events=[noisier(one) if isinstance(one, LaserScan) else one for one in log.events])


def half(log: Log, rig: Rig, rng: np.random.Generator) -> Log:
    """Every second scan, from the first or the second on."""
    return thinned(log, 2, 1 - int(rng.integers(2)))


def late(log: Log, rig: Rig, rng: np.random.Generator) -> Log:
    """Odometry stamped a tenth of a second later or earlier than it was read."""
    shift = int(rng.choice([-1.0, 1.0]) * _LATE_S * 1e9)
    moved = [replace(e, stamp_ns=e.stamp_ns + shift) if isinstance(e, OdometryReading) else e for e in log.events]
    return replace(log, events=in_order(moved))


def absent(log: Log, rig: Rig, rng: np.random.Generator) -> Log:
    """No odometry at all."""
    return replace(log, events=[one for one in log.events if not isinstance(one, OdometryReading)])


#: Kinds of perturbations of a log of 2D scans and wheel odometry.
PERTURBATIONS: dict[str, Perturbation] = {one.__name__: one for one in (heading3, slips, noise2, half, late, absent)}


def _deltas(log: Log) -> list[FloatArray]:
    """The odometry's steps (x, y, theta)."""
    return [planar_delta(inverse(a.odom_T_body) @ b.odom_T_body) for a, b in pairwise(log.odometry)]


def _turned(log: Log, deltas: Sequence[FloatArray], turns: FloatArray) -> Log:
    """The log with steps of the odometry, each of which turns by so much more, rad."""
    steps = (planar_transform(x, y, theta + float(more)) for (x, y, theta), more in zip(deltas, turns, strict=True))
    moved = accumulate(steps, np.matmul, initial=log.odometry[0].odom_T_body)
    turned = [replace(e, odom_T_body=next(moved)) if isinstance(e, OdometryReading) else e for e in log.events]
    return replace(log, events=turned)
