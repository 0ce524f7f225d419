"""Clouds of a lidar that turned while it moved: where nobody compensated them, the log is mapped again with that done.

What is seen at its own moment asks for the motion within a turn. By odometry it is known beforehand; else by the map of
the clouds as they come, which is bent by little: it is the motion that the next map is made with.
"""

from __future__ import annotations

from collections.abc import Callable
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
    slam: PlaneSlam, log: Log, rig: Rig, map_again: Callable[[Rig, Sweeps | None], PlaneSlam]
) -> Compensated | None:
    """The run with what a lidar saw in each turn taken at its own moment; None: its clouds are of one moment each.

    A turn that the rig states is believed. Else clouds say whether there is one; of those that lidars take the one is
    kept under whose map they agree best, if that is better than of none: then a note in the log tells of it. A run that
    keeps its measurements on the disk alone stays as it is.

    Args:
        slam, log, rig: a run that has all its keyframes.
        map_again: maps the log with another rig, and with the motion within turns; None: that of the odometry.
    """
    sensors = rig.of_kind("cloud")
    if len(sensors) != 1 or len(slam.keyframes) < 3 or isinstance(slam.keyframes, ForgottenKeyframes):
        return None
    ((name, sensor),) = sensors.items()
    by_wheels = OdometryTrack(log.odometry, rig.odometry) if log.measured_motion else None

    def along(run: PlaneSlam) -> OdometryTrack:
        return sweeps_along(run.trajectory).track if by_wheels is None else by_wheels

    def mapped(turning: Sensor, before: PlaneSlam) -> Compensated:
        other = rig.model_copy(update={"sensors": {**rig.sensors, name: turning}})
        return Compensated(map_again(other, sweeps_along(before.trajectory) if by_wheels is None else None), other)

    if sensor.sweep_s > 0.0:
        return mapped(sensor, slam) if by_wheels is None else None
    clouds = {scan.stamp_ns: scan for scan in log.scans(name) if isinstance(scan, CloudScan)}
    with slam.clock.stage("turns"):
        search = TurnSearch(sensor, slam.keyframes, along(slam), clouds)
        if not search.is_suspected(slam.trajectory, along(slam)):
            return None
        shown, best = search.turn(slam.trajectory, along(slam)), search.agreement(Turn(), slam.trajectory, along(slam))
    turn = shown and shown._replace(seconds=float(np.copysign(_FIRST_S, shown.seconds)))
    found, tried = None, set[float]()
    while turn is not None and turn.seconds not in tried and len(tried) < _MAPS:
        tried.add(turn.seconds)
        other = mapped(turn.state(sensor), slam if found is None else found.slam)
        with slam.clock.stage("turns"):
            agreement = search.agreement(turn, other.slam.trajectory, along(other.slam))
            if agreement > best:
                found, best = other, agreement
                more = search.left(turn, other.slam.keyframes, other.slam.trajectory, along(other.slam))
                shown = turn._replace(seconds=turn.seconds + more)
        turn = shown and shown.usual()
    if found is not None:
        seconds = found.rig.sensors[name].sweep_s
        log.notes.append(f"{name}: clouds are turns of {seconds:g} s of a lidar that moved: taken as seen in time")
    return found
