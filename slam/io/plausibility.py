"""What no working sensor says: distances in another unit, one scan over and over, two scans at one time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import groupby, pairwise
from typing import TypeVar

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import are_apart, evenly
from slam.sensors.log import CloudScan, Event, LaserScan, Log, OdometryReading
from slam.sensors.rig import Rig
from spplanes._check import FloatArray

#: Fewer scans of one time, or alike, may be chance, or all that there is.
_FEW = 5

Scan = TypeVar("Scan", LaserScan, CloudScan)


def plausible(log: Log, rig: Rig) -> Log:
    """The log without the scans that were not made when and where they say, which its notes tell of.

    One of which no scan can be read, all have one time, or distances are in another unit than metres is refused.
    """
    scans, level = log.scans(), rig.of_kind("line")
    clouds = [scan for scan in scans if isinstance(scan, CloudScan)]
    _check_some(log, clouds, lambda scan: np.linalg.norm(scan.points.reshape(-1, 3), axis=1), 1000.0)
    levels = [scan for scan in scans if isinstance(scan, LaserScan) and scan.sensor in level]
    _check_some(log, levels, lambda scan: scan.ranges, 150.0)
    frozen: set[int] = set()
    for sensor in sorted({scan.sensor for scan in levels}):
        own = [scan for scan in levels if scan.sensor == sensor]
        _check_times(log, sensor, own)
        frozen |= _frozen(log, sensor, own)
    return replace(log, events=[event for event in log.events if id(event) not in frozen]) if frozen else log


def check_events(log: Log) -> None:
    """Refuse a log, made by hand as like as not, whose events are out of order or are not what their class says.

    What is read from files when it is asked for is checked then.
    """
    for before, event in pairwise([*log.events[:1], *log.events]):
        if problem := _problem_of(event, before.stamp_ns):
            raise LogError(log.source, f"at {event.stamp_ns / 1e9:.3f} s: {problem}")


def _problem_of(event: Event, before_ns: int) -> str:
    """What is amiss with an event, after one of a time, in a clause; nothing where nothing is."""
    if event.stamp_ns < before_ns:
        return f"expected events in the order of their times, got this one after {before_ns / 1e9:.3f} s"
    if type(event) is OdometryReading:
        pose = np.asarray(event.odom_T_body)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            return f"expected odometry with a finite pose (4, 4), got shape {pose.shape} or NaN in it"
    if type(event) is LaserScan:
        of_beams = np.shape(event.ranges), np.shape(event.angles)
        made = all(isinstance(numbers, np.ndarray) for numbers in (event.ranges, event.angles))
        if not made or of_beams[0] != of_beams[1] or len(of_beams[0]) != 1:
            return f"expected a 2D scan's ranges and angles as two arrays (B,), got shapes {of_beams[0]}, {of_beams[1]}"
    return ""


def _check_some(log: Log, scans: Sequence[Scan], distances: Callable[[Scan], np.ndarray], most_m: float) -> None:
    """Refuse a log none of whose scans can be read, or of a few of which half of the returns lie beyond metres."""
    few = [scans[index] for index in evenly(len(scans), 4)]
    medians, failure = [], None
    for number, scan in enumerate((*few, *scans)):
        if number >= len(few) and (medians or failure is None):
            break  # more are looked at only where none of the few could be read
        try:
            seen = distances(scan)
            returns = seen[np.isfinite(seen) & (seen > 0.0)]
            medians += [float(np.median(returns))] if len(returns) else []
        except LogError as error:
            failure = failure or error
    if failure is not None and not medians:
        raise failure
    if medians and min(medians) > most_m:
        raise LogError(
            log.source,
            f"half of the returns are more than {min(medians):,.0f} m away: expected metres from the sensor; are these "
            "millimetres, or coordinates on a map?",
        )


def _check_times(log: Log, sensor: str, scans: list[LaserScan]) -> None:
    """Tell of scans of a sensor at the time of the one before, for they are not used; refuse one time for all."""
    again = sum(scan.stamp_ns == before.stamp_ns for before, scan in pairwise(scans))
    if again and again == len(scans) - 1 and len(scans) >= _FEW:
        raise LogError(log.source, f"all {len(scans)} scans of {sensor!r} have one time: expected times that grow")
    if again:
        log.notes.append(
            f"{again} of {len(scans)} scans of {sensor!r} have the time of the one before: of each time one is used"
        )


def _frozen(log: Log, sensor: str, scans: list[LaserScan]) -> set[int]:
    """Scans that are the one before to the last bit though the wheels have moved on, by identity: the sensor hangs."""
    readings = log.measured_motion
    if not readings:
        return set()
    stamps = np.array([reading.stamp_ns for reading in readings], dtype=np.int64)

    def at(scan: LaserScan) -> FloatArray:
        """The last odometry up to a scan, odom_T_body (4, 4)."""
        return readings[max(int(np.searchsorted(stamps, scan.stamp_ns, side="right")) - 1, 0)].odom_T_body

    frozen: set[int] = set()
    for _, alike in groupby(scans, key=lambda scan: scan.ranges.tobytes()):
        first, *others = alike
        there = at(first)
        again = {id(scan) for scan in others if are_apart(there, at(scan), metres=0.05, radians=0.05)}
        frozen |= again if len(again) >= _FEW else set()
    if frozen:
        times = [scan.stamp_ns * 1e-9 for scan in scans if id(scan) in frozen]
        log.notes.append(
            f"sensor {sensor!r} repeats itself while the wheels move, {len(frozen)} times between {times[0]:.3f} and "
            f"{times[-1]:.3f} s: these scans were left out"
        )
    return frozen
