"""Folders of clouds: one file a scan, with times, poses and odometry beside them if there are any.

- Clouds lie in the folder, or in one of its folders `velodyne`, `velodyne_points/data`, `clouds` or `scans`. Their
  order is that of their names, numbers in them counted as numbers.
- Their times: `times.txt` (a line of seconds for each cloud); else the names, where they are times (a number with a
  decimal point, or one of 10, 13, 16 or 19 digits: s, ms, us, ns); else those of a TUM file with a row for each cloud;
  else one second each.
- `poses.tum`, `poses.txt`, `trajectory.tum`: poses of the body, TUM or KITTI; else the VIEWPOINTs of PCD files, the
  sensor's. `map` takes them; odometry is only what is called so: `odometry.tum`, `odometry.txt`, or a file given.
  KITTI rows, and TUM rows where the clouds have no times, belong to the clouds in order; if there are more rows than
  clouds, to the clouds by the number in the name, counted from 0.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import inverse
from slam.io._numbers import nanoseconds, read_rows, seconds_from_ns
from slam.io.clouds import is_cloud_file, read_cloud, weigh_cloud
from slam.io.clouds.e57 import count_e57, read_e57
from slam.io.clouds.pcd import read_header
from slam.io.odometry_file import check_reach, taken_from
from slam.io.trajectories import Trajectory, read_kitti, read_tum, write_tum
from slam.sensors.log import CloudScan, Event, Log, OdometryReading, StoredCloud
from spplanes._check import FloatArray, as_shape
from spplanes.clouds.arrange import Grid, arrange

#: Name of the sensor where no rig gives one.
SENSOR = "scanner"
#: Time between scans that have no clock, ns.
SCAN_PERIOD_NS = 1_000_000_000
#: A pose belongs to a scan where it is at most this far in time, or where two poses this close lie around it, ns.
POSE_GAP_NS = 500_000_000

_INSIDE = ("velodyne", "velodyne_points/data", "clouds", "scans")
_POSES, _ODOMETRY = ("poses.tum", "poses.txt", "trajectory.tum"), ("odometry.tum", "odometry.txt")
_TIMES = "times.txt"
#: Text files that are no clouds.
_NOT_CLOUDS = (*_POSES, *_ODOMETRY, _TIMES, "intrinsics.txt", "calib.txt", "associations.txt", "timestamps.txt")
#: Formats that other things than clouds come in too: taken where there are no others.
_AMBIGUOUS = (".txt", ".csv", ".npy", ".npz", ".png")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_DIGITS_NS = {10: 1_000_000_000, 13: 1_000_000, 16: 1_000, 19: 1}


def clouds_in(folder: Path) -> list[Path]:
    """The clouds of a folder in order; of several formats those of the most common."""
    return _chosen(folder)[0]


def _chosen(folder: Path) -> tuple[list[Path], list[str]]:
    """The clouds of a folder in order, and a note of what else there is that could be clouds."""
    for place in (folder, *(folder / name for name in _INSIDE)):
        if not place.is_dir():
            continue
        found = [entry for entry in place.iterdir() if _is_scan(entry)]
        if found:
            counts = Counter(entry.suffix.lower() for entry in found)
            suffix = max(sorted(counts), key=lambda ending: (ending not in _AMBIGUOUS, counts[ending]))
            rest = [f"{counts[end]} {end}" for end in sorted(counts) if end != suffix and end not in _AMBIGUOUS]
            notes = [f"read {counts[suffix]} {suffix} clouds, left out {' and '.join(rest)}"] if rest else []
            return sorted((entry for entry in found if entry.suffix.lower() == suffix), key=_order), notes
    return [], []


def read_cloud_folder(
    folder: Path,
    *,
    sensor: str = SENSOR,
    grid: Grid | None = None,
    body_T_sensor: FloatArray | None = None,
    odometry: Path | None = None,
) -> Log:
    """Read a folder of clouds; the clouds themselves stay in their files until they are asked for.

    Args:
        folder: with the names above.
        sensor: name of the sensor in the rig.
        grid: shape of the range image of clouds without order; None: found in each.
        body_T_sensor: where it sits, shape (4, 4): poses that the clouds themselves tell are the sensor's.
        odometry: a TUM or KITTI file, in place of what the folder has.

    Raises:
        LogError: one sentence with the file: no clouds, a header that is wrong, times or poses that are not as many.
    """
    folder = Path(folder)
    paths, notes = _chosen(folder)
    if not paths:
        raise LogError(folder, "expected a folder of clouds, found none")
    for path in paths:
        weigh_cloud(path)
    posed_by, moved_by = _file_of(folder, _POSES), odometry or _file_of(folder, _ODOMETRY)
    poses, moves = _rows_of(posed_by), _rows_of(moved_by)
    if poses is None:
        poses = _told_by_files(paths, np.eye(4) if body_T_sensor is None else body_T_sensor)
    stamps = _stamps(folder, paths, [rows for rows in (moves, poses) if isinstance(rows, Trajectory)])
    world_T_body = None if poses is None else _poses_at(folder, poses, paths, stamps)
    events: list[Event] = []
    if moved_by is not None and moves is not None:
        events += _odometry(moved_by, moves, folder, paths, stamps, must_reach=odometry is not None)
    for index, (path, stamp) in enumerate(zip(paths, stamps, strict=True)):
        pose = None if world_T_body is None else world_T_body[index]
        events.append(StoredCloud(stamp, sensor, partial(grid_in, path, grid), pose))
    events.sort(key=lambda event: (event.stamp_ns, not isinstance(event, OdometryReading)))
    if odometry is not None:
        notes.append(taken_from(odometry, len(events) - len(paths)))
        return Log(events, folder, notes, odometry_source=odometry)
    return Log(events, folder, [*notes, *_said_of(posed_by, world_T_body is not None and moved_by is None)])


def read_e57_log(
    path: Path, *, sensor: str = SENSOR, grid: Grid | None = None, body_T_sensor: FloatArray | None = None
) -> Log:
    """Read the scans of an E57 file, one second each, with their poses where all have one.

    Raises:
        LogError: what `slam.io.clouds.e57` says.
    """
    clouds = [read_e57(path, index) for index in range(count_e57(path))]
    mount = np.eye(4) if body_T_sensor is None else body_T_sensor
    posed = any(cloud.world_T_sensor is not None for cloud in clouds)
    events: list[Event] = []
    for index, cloud in enumerate(clouds):
        stamp, told = index * SCAN_PERIOD_NS, cloud.world_T_sensor
        pose = None if not posed else (np.eye(4) if told is None else told) @ inverse(mount)
        events.append(CloudScan(stamp, sensor, arrange(cloud.points, grid), pose))
    return Log(events, path, _said_of(None, posed))


def grid_in(path: Path, grid: Grid | None = None) -> FloatArray:
    """The points of a file as a grid round the sensor, shape (S, B, 3), m; NaN = no return."""
    return arrange(read_cloud(path).points, grid)


def _is_scan(path: Path) -> bool:
    return path.is_file() and is_cloud_file(path) and path.name not in _NOT_CLOUDS


def _order(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Names in the order of their numbers: 2 before 10."""
    parts = re.split(r"(\d+)", path.stem)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], path.name


def _said_of(posed_by: Path | None, posed: bool) -> list[str]:
    """That poses are no odometry, where a log has them and nothing else."""
    if not posed:
        return []
    told = "the scans' own poses" if posed_by is None else f"the poses of {posed_by.name}"
    way = "" if posed_by is None else f" (for slam: --odometry {posed_by.name})"
    return [f"no odometry: {told} are not taken for it{way}"]


def _file_of(folder: Path, names: tuple[str, ...]) -> Path | None:
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _rows_of(path: Path | None) -> Trajectory | FloatArray | None:
    """TUM as a trajectory, KITTI as poses (N, 4, 4), by the number of words in a row; None: no such file."""
    if path is None:
        return None
    if path.suffix == ".txt" and _words_in_row(path) == 12:
        return read_kitti(path)
    return read_tum(path)


def _told_by_files(paths: list[Path], body_T_sensor: FloatArray) -> FloatArray | None:
    """world_T_body (N, 4, 4) by the VIEWPOINT of PCD files; None where all are the identity, or of other formats."""
    told = [read_header(path).world_T_sensor if path.suffix.lower() == ".pcd" else None for path in paths]
    if all(pose is None for pose in told):
        return None
    return np.array([np.eye(4) if pose is None else pose for pose in told]) @ inverse(body_T_sensor)


def _words_in_row(path: Path) -> int:
    try:
        with path.open("rb") as stream:
            head = stream.read(1 << 16).decode("ascii", errors="replace")
    except OSError as error:
        raise LogError(path, f"cannot be read: {error.strerror or error}") from error
    rows = (line.split() for line in head.splitlines() if line.strip() and not line.strip().startswith("#"))
    return len(next(rows, []))


def _stamps(folder: Path, paths: list[Path], clocks: list[Trajectory]) -> list[int]:
    """Time of every cloud, ns, ascending."""
    if (folder / _TIMES).is_file():
        times, _, _ = read_rows(folder / _TIMES, columns=1, stamp_columns=1)
        if len(times) != len(paths):
            raise LogError(folder / _TIMES, f"expected {len(paths)} times, one for each cloud, got {len(times)}")
        stamps = times[:, 0].tolist()
    else:
        named = [_time_in(path.stem) for path in paths]
        stamps = [stamp for stamp in named if stamp is not None]
        if len(stamps) != len(paths):
            clock = next((rows for rows in clocks if len(rows) == len(paths)), None)
            stamps = [k * SCAN_PERIOD_NS for k in range(len(paths))] if clock is None else clock.stamps_ns.tolist()
    if any(b <= a for a, b in pairwise(stamps)):
        raise LogError(folder, "expected times of the clouds that ascend, got one that repeats or runs backwards")
    return stamps


def _time_in(stem: str) -> int | None:
    """The time that a name tells, ns."""
    numbers = _NUMBER.findall(stem)
    if len(numbers) != 1:
        return None
    (word,) = numbers
    if "." in word:
        try:
            return nanoseconds(word)
        except ValueError:
            return None
    return int(word) * _DIGITS_NS[len(word)] if len(word) in _DIGITS_NS and word[0] != "0" else None


def _has_clock(folder: Path, paths: list[Path]) -> bool:
    return (folder / _TIMES).is_file() or all(_time_in(path.stem) is not None for path in paths)


def _in_order(source: Path, poses: FloatArray, paths: list[Path]) -> FloatArray:
    """The pose of every cloud from rows without times, shape (N, 4, 4)."""
    if len(poses) == len(paths):
        return poses
    numbers = [int(words[-1]) if (words := re.findall(r"\d+", path.stem)) else len(poses) for path in paths]
    if len(poses) > len(paths) and max(numbers) < len(poses):
        return poses[numbers]
    raise LogError(source, f"expected a pose for each of the {len(paths)} clouds, got {len(poses)}")


def _poses_at(folder: Path, rows: Trajectory | FloatArray, paths: list[Path], stamps: list[int]) -> FloatArray:
    """world_T_body at every cloud, shape (N, 4, 4)."""
    if not isinstance(rows, Trajectory):
        return _in_order(folder, rows, paths)
    if not _has_clock(folder, paths):
        return _in_order(folder, rows.poses, paths)
    for path, stamp in zip(paths, stamps, strict=True):
        after = int(np.searchsorted(rows.stamps_ns, stamp))
        near = rows.stamps_ns[max(after - 1, 0) : after + 1]
        if np.abs(near - stamp).min() > POSE_GAP_NS:
            raise LogError(path, f"expected a pose within {POSE_GAP_NS / 1e9} s of the cloud's time, found none")
    return rows.poses_at(stamps)


def _odometry(
    path: Path, rows: Trajectory | FloatArray, folder: Path, paths: list[Path], stamps: list[int], *, must_reach: bool
) -> list[OdometryReading]:
    if isinstance(rows, Trajectory) and _has_clock(folder, paths):
        if must_reach:
            check_reach(path, rows, stamps)
        return [OdometryReading(t, pose) for t, pose in zip(rows.stamps_ns.tolist(), rows.poses, strict=True)]
    poses = _in_order(path, rows.poses if isinstance(rows, Trajectory) else rows, paths)
    return [OdometryReading(t, pose) for t, pose in zip(stamps, poses, strict=True)]


def has_clouds(folder: Path, *, surely: bool = False) -> bool:
    """Whether a folder is one of clouds; `surely`: of a format that nothing else comes in."""
    found = clouds_in(folder) if folder.is_dir() else []
    return bool(found) and not (surely and found[0].suffix.lower() in _AMBIGUOUS)


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
