"""Writer of folders of clouds: what `read_cloud_folder` reads, in full precision."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from slam.io._numbers import seconds_from_ns
from slam.io.trajectories import Trajectory, write_tum
from slam.sensors.log import CloudScan, Log, OdometryReading
from spplanes._check import FloatArray, as_shape


def write_cloud_folder(log: Log, folder: Path | str) -> None:
    """Write a log of one 3D sensor and odometry into a folder that exists.

    It gets `clouds/000000.pcd` and so on, `times.txt`, and `odometry.tum` and `poses.tum` where the log has them.
    Points and times read back as they were, rotations to rounding error. Equal logs give equal bytes.

    Raises:
        ValueError: no 3D scan, 2D scans, 3D scans of two sensors, or some with a pose of the robot and some without.
    """
    folder, scans = Path(folder), _scans(log)
    (folder / "clouds").mkdir()
    for index, scan in enumerate(scans):
        write_pcd(folder / "clouds" / f"{index:06d}.pcd", scan.points)
    stamps = [scan.stamp_ns for scan in scans]
    (folder / "times.txt").write_bytes("".join(seconds_from_ns(stamp) + "\n" for stamp in stamps).encode("ascii"))
    odometry = [event for event in log.events if isinstance(event, OdometryReading)]
    _write_poses(folder / "odometry.tum", [one.stamp_ns for one in odometry], [one.odom_T_body for one in odometry])
    _write_poses(folder / "poses.tum", stamps, [one.world_T_body for one in scans if one.world_T_body is not None])


def write_pcd(path: Path | str, points: FloatArray) -> None:
    """Write points as binary PCD in double precision: organised (H, W, 3) or not (N, 3), m; NaN = no return.

    Raises:
        ValueError: another shape.
    """
    rows = as_shape("points", points if np.ndim(points) == 3 else [points], (None, None, 3), finite=False)
    height, width, _ = rows.shape
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
        f"WIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {width * height}\nDATA binary\n"
    )
    Path(path).write_bytes(head.encode("ascii") + rows.astype("<f8").tobytes())


def _scans(log: Log) -> list[CloudScan]:
    """The 3D scans of the one sensor there is."""
    scans = list(log.scans())
    clouds = [scan for scan in scans if isinstance(scan, CloudScan)]
    if not clouds or len(clouds) != len(scans) or len({scan.sensor for scan in clouds}) != 1:
        names = ", ".join(sorted({scan.sensor for scan in scans})) or "none"
        raise ValueError(f"log: expected scans of one 3D sensor, got those of {names}")
    if len({scan.world_T_body is None for scan in clouds}) != 1:
        raise ValueError("log: expected a pose of the robot with every scan or with none, got some")
    return clouds


def _write_poses(path: Path, stamps: Sequence[int], poses: Sequence[FloatArray]) -> None:
    if poses:
        write_tum(path, Trajectory(np.array(stamps, dtype=np.int64), np.array(poses)))
