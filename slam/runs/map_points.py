"""Some returns of a log in the world, for the eye: thinned evenly over scans and beams."""

from __future__ import annotations

import numpy as np

from slam.errors import LogError
from slam.frontend.measurement import usable_points, usable_ranges
from slam.geometry.frames import lift
from slam.io.trajectories import Trajectory
from slam.sensors.log import CloudScan, LaserScan, Log
from slam.sensors.rig import Rig, Sensor
from spplanes._check import FloatArray

#: Points that are kept: a page of some 150 kB more, drawn in some 10 ms.
MOST_POINTS = 15_000
#: Scans that they come from, evenly over the run: 3D scans are read from their files again.
_MOST_CLOUDS, _MOST_SCANS = 24, 400


def points_of_map(log: Log, rig: Rig, scans: Trajectory) -> FloatArray:
    """Returns of scans at their poses, shape (N, 3), m, N at most `MOST_POINTS`; the same ones each time.

    Args:
        log: whose scans; those of sensors that the rig does not have, and of files that cannot be read, are left out.
        rig: where the sensors sit and how far they see.
        scans: world_T_body at the scans, by their times.
    """
    known = [one for one in log.scans() if one.sensor in rig.sensors]
    rows = np.searchsorted(scans.stamps_ns, [one.stamp_ns for one in known])
    posed = [
        (one, row)
        for one, row in zip(known, rows.tolist(), strict=True)
        if row < len(scans) and scans.stamps_ns[row] == one.stamp_ns
    ]
    most = _MOST_CLOUDS if any(isinstance(one, CloudScan) for one, _ in posed) else _MOST_SCANS
    chosen = [posed[k] for k in _evenly(len(posed), most)]
    parts = [np.empty((0, 3))]
    for scan, row in chosen:
        sensor = rig.sensors[scan.sensor]
        try:
            seen = returns_of(scan, sensor)
        except LogError:
            continue
        kept = seen[_evenly(len(seen), MOST_POINTS // len(chosen))]
        parts.append(lift(kept, scans.poses[row] @ sensor.body_T_sensor))
    return np.concatenate(parts)


def returns_of(scan: LaserScan | CloudScan, sensor: Sensor) -> FloatArray:
    """What a scan met within the reach of its sensor, in the sensor's frame, shape (N, 3), m."""
    if isinstance(scan, CloudScan):
        points = usable_points(scan.points, sensor).reshape(-1, 3)
    else:
        bearings = np.stack((np.cos(scan.angles), np.sin(scan.angles), np.zeros(len(scan.angles))), axis=1)
        points = usable_ranges(scan.ranges, sensor)[:, None] * bearings
    return points[np.isfinite(points).all(axis=1)]


def _evenly(count: int, most: int) -> np.ndarray:
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))
