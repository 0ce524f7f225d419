"""Clouds of a lidar that turned while it moved: where nobody compensated them, the log is mapped again with that done.

What is seen at its own moment asks for the motion within a turn. By odometry it is known beforehand; else by the map of
the clouds as they come, which is bent by little: it is the motion that the next map is made with.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from slam.frontend.deskewing import Sweeps
from slam.frontend.odometry import OdometryTrack
from slam.planeslam import PlaneSlam
from slam.sensors.log import CloudScan, Log
from slam.sensors.rig import Rig, Sensor
from slam.session.replay import ForgottenKeyframes
from slam.tracking.turns import Turn, TurnSearch, sweeps_along

#: Most lidars turn so long, s; and a log is mapped again so often at most.
_FIRST_S, _MAPS = 0.1, 3


class Compensated(NamedTuple):
    """A run mapped again, and the rig that says how its lidar turns."""

    slam: PlaneSlam
    rig: Rig


def compensated(
    slam: PlaneSlam, log: Log, rig: Rig, map_again: Callable[[Rig, Sweeps | None], PlaneSlam], *, has_more: bool = True
) -> Compensated | None:
    """The run with what a lidar saw in each turn taken at its own moment; None: its clouds are of one moment each.

    A turn that the rig states is believed. Else clouds say whether there is one; of those that lidars take the one is
    kept under whose map they agree best, if that is better than of none: then a note in the log tells of it. As it is
    stays a run that keeps its measurements on the disk alone, and one that was mapped again before it was resumed.

    Args:
        slam, log, rig: a run that has all its keyframes.
        map_again: maps the log with another rig, and with the motion within turns; None: that of the odometry.
        has_more: whether it has keyframes that it did not have when it was resumed.
    """
    sensors = rig.of_kind("cloud")
    if len(sensors) != 1 or len(slam.keyframes) < 3 or isinstance(slam.keyframes, ForgottenKeyframes):
        return None
    if slam.recorder.is_anew and not has_more:
        return None
    ((name, sensor),) = sensors.items()
    by_wheels = OdometryTrack(log.odometry, rig.odometry) if log.measured_motion else None

    def mapped(turning: Sensor, before: PlaneSlam) -> Compensated:
        other = rig.model_copy(update={"sensors": {**rig.sensors, name: turning}})
        return Compensated(map_again(other, sweeps_along(before.trajectory) if by_wheels is None else None), other)

    if sensor.sweep_s > 0.0:
        return mapped(sensor, slam) if by_wheels is None else None
    scans = reversed(log.scans(name))  # of two of one time the first is a keyframe
    clouds = {scan.stamp_ns: scan for scan in scans if isinstance(scan, CloudScan)}
    found = _as_shown(slam, sensor, clouds, by_wheels, mapped)
    if found is not None:
        seconds = found.rig.sensors[name].sweep_s
        log.notes.append(f"{name}: clouds are turns of {seconds:g} s of a lidar that moved: taken as seen in time")
    return found


def _as_shown(
    slam: PlaneSlam,
    sensor: Sensor,
    clouds: Mapping[int, CloudScan],
    by_wheels: OdometryTrack | None,
    mapped: Callable[[Sensor, PlaneSlam], Compensated],
) -> Compensated | None:
    """The run under whose turn its clouds, by their times, agree best; None: under none better than as they come."""

    def along(run: PlaneSlam) -> OdometryTrack:
        return sweeps_along(run.trajectory).track if by_wheels is None else by_wheels

    with slam.clock.stage("turns"):
        track = along(slam)
        search = TurnSearch(sensor, slam.keyframes, track, clouds)
        if not search.is_suspected(slam.trajectory, track):
            return None
        shown, best = search.turn(slam.trajectory, track), search.agreement(Turn(), slam.trajectory, track)
    turn = shown and shown._replace(seconds=float(np.copysign(_FIRST_S, shown.seconds)))
    found, tried = None, set[float]()
    while turn is not None and turn.seconds not in tried and len(tried) < _MAPS:
        tried.add(turn.seconds)
        other = mapped(turn.state(sensor), slam if found is None else found.slam)
        with slam.clock.stage("turns"):
            trajectory, track = other.slam.trajectory, along(other.slam)
            agreement = search.agreement(turn, trajectory, track)
            if agreement > best:
                found, best = other, agreement
                more = search.left(turn, other.slam.keyframes, trajectory, track)
                shown = turn._replace(seconds=turn.seconds + more)
        turn = shown and shown.usual()
    return found
