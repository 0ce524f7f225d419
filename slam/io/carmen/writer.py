"""Writer of CARMEN logs: ODOM and ROBOTLASERk records in full precision."""

from __future__ import annotations

import gzip
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slam.io._numbers import seconds_from_ns
from slam.sensors.log import LaserScan, Log, OdometryReading
from slam.sensors.rig import Rig
from spplanes._check import FloatArray


def write_carmen(log: Log, rig: Rig, path: Path | str) -> None:
    """Write a log of 2D lasers and odometry, gzip if the name ends in .gz.

    Numbers are the shortest that read back to the same float: `read_carmen` with the same rig returns the same ranges,
    bit for bit, and bearings to rounding error. No returns are written as the maximum range. A scan without a pose of
    its own gets the last odometry before it. Equal logs give equal bytes.

    Raises:
        ValueError: an event that CARMEN has no record for, or a sensor whose record is not ROBOTLASERk.
    """
    path = Path(path)
    text = "".join(line + "\n" for line in _lines(log, rig)).encode("ascii")
    path.write_bytes(gzip.compress(text, compresslevel=6, mtime=0) if path.suffix == ".gz" else text)


def _lines(log: Log, rig: Rig) -> Iterator[str]:
    yield "# CARMEN log: metres, radians; see rig.yaml for mounts and noise"
    last = np.eye(4)
    for event in log.events:
        if isinstance(event, OdometryReading):
            last = event.odom_T_body
            yield f"ODOM {_pose(last)} 0 0 0 {_tail(event.stamp_ns)}"
        elif isinstance(event, LaserScan):
            yield _laser(event, rig, last if event.world_T_body is None else event.world_T_body)
        else:
            raise ValueError(f"log: expected 2D scans and odometry only, got a 3D scan of {event.sensor!r}")


def _laser(scan: LaserScan, rig: Rig, world_T_body: FloatArray) -> str:
    """ROBOTLASERk type start fov step max accuracy mode n r... 0 laser robot tv rv front side axis t host t."""
    sensor = rig.sensors[scan.sensor]
    record = sensor.record or scan.sensor
    if not record.startswith("ROBOTLASER"):
        raise ValueError(f"rig: expected a record ROBOTLASERk for {scan.sensor!r}, got {record!r}")
    step = float(scan.angles[-1] - scan.angles[0]) / max(len(scan.angles) - 1, 1)
    if not np.allclose(np.diff(scan.angles), step, rtol=0.0, atol=1e-9):
        raise ValueError(f"log: expected equally spaced bearings from {scan.sensor!r}, got unequal ones")
    ranges = np.where(np.isnan(scan.ranges), sensor.range_max_m, scan.ranges)
    head = f"{float(scan.angles[0])!r} {step * (len(scan.angles) - 1)!r} {step!r} {sensor.range_max_m!r}"
    body = " ".join(map(repr, ranges.tolist()))
    poses = f"{_pose(world_T_body @ sensor.body_T_sensor)} {_pose(world_T_body)}"
    return (
        f"{record} 0 {head} {sensor.range_sigma_m!r} 0 {len(ranges)} {body} 0 {poses} 0 0 0 0 0 {_tail(scan.stamp_ns)}"
    )


def _pose(transform: FloatArray) -> str:
    x, y = transform[:2, 3].tolist()
    theta = float(np.arctan2(transform[1, 0], transform[0, 0]))
    return f"{x!r} {y!r} {theta!r}"


def _tail(stamp_ns: int) -> str:
    return f"{seconds_from_ns(stamp_ns)} simulation {seconds_from_ns(stamp_ns)}"
