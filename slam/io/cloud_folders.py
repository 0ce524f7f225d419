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
from contextlib import suppress
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import inverse
from slam.io.clouds import is_cloud_file, read_cloud, weigh_cloud
from slam.io.clouds.cloud import grid_of
from slam.io.clouds.pcd import read_header, write_pcd
from slam.io.clouds.survey import read_e57_scans
from slam.io.raw import nanoseconds, numbered_words, read_rows, seconds_from_ns
from slam.io.scan_files import ScanFiles, check_reach, first_file, in_order, taken_from
from slam.io.trajectories import Trajectory, read_kitti, read_tum, write_tum
from slam.sensors.log import CloudScan, Event, Log, OdometryReading
from slam.sensors.rig import Sensor
from spplanes._check import FloatArray
from spplanes.clouds.arrange import arrange
from spplanes.clouds.turn import told_turn

#: Name of the sensor where no rig gives one.
SENSOR = "scanner"
#: Time between scans that have no clock, ns.
SCAN_PERIOD_NS = 1_000_000_000

_POSES, _ODOMETRY = ("poses.tum", "poses.txt", "trajectory.tum"), ("odometry.tum", "odometry.txt")
_TIMES = "times.txt"
#: Text files that are no clouds.
_NOT_CLOUDS = (*_POSES, *_ODOMETRY, _TIMES, "intrinsics.txt", "calib.txt", "associations.txt", "timestamps.txt")
#: Formats that other things than clouds come in too: taken where there are no others.
_AMBIGUOUS = (".txt", ".csv", ".npy", ".npz", ".png")
_DIGITS_NS = {10: 1_000_000_000, 13: 1_000_000, 16: 1_000, 19: 1}


def clouds_in(folder: Path) -> tuple[list[Path], list[str]]:
    """The clouds of a folder in order, of several formats those of the most common, and a note of the others."""
    for place in (folder / name for name in ("", "velodyne", "velodyne_points/data", "clouds", "scans")):
        if not place.is_dir():
            continue
        files = (entry for entry in place.iterdir() if entry.is_file() and entry.name not in _NOT_CLOUDS)
        found = [entry for entry in files if is_cloud_file(entry)]
        if found:
            counts = Counter(entry.suffix.lower() for entry in found)
            suffix = max(sorted(counts), key=lambda ending: (ending not in _AMBIGUOUS, counts[ending]))
            rest = [f"{counts[end]} {end}" for end in sorted(counts) if end != suffix and end not in _AMBIGUOUS]
            notes = [f"read {counts[suffix]} {suffix} clouds, left out {' and '.join(rest)}"] if rest else []
            return sorted((entry for entry in found if entry.suffix.lower() == suffix), key=_order), notes
    return [], []


def read_cloud_folder(folder: Path, name: str, sensor: Sensor, odometry: Path | None = None) -> Log:
    """Read a folder of clouds; the clouds themselves stay in their files until they are asked for.

    The poses that they tell themselves are those of `sensor`, which is called `name` in the rig; `odometry` is a TUM or
    KITTI file in place of what the folder has.
    """
    paths, notes = clouds_in(folder)
    for path in paths:
        weigh_cloud(path)
    posed_by, moved_by = first_file(folder, _POSES), odometry or first_file(folder, _ODOMETRY)
    poses, moves = _rows_of(posed_by), _rows_of(moved_by)
    if posed_by is None and paths and paths[0].suffix.lower() == ".pcd":  # so are the others
        poses = _of_body([read_header(path).world_T_sensor for path in paths], sensor)
    stamps, timed = _stamps(folder, paths, [rows for rows in (moves, poses) if isinstance(rows, Trajectory)])
    scans = ScanFiles(folder, "cloud", paths, stamps, timed)
    world_T_body = None if poses is None else scans.poses(posed_by or folder, poses)
    grid = grid_of(sensor)
    events = scans.events(
        name,
        world_T_body,
        points=lambda path: arrange(read_cloud(path).points, grid),
        turn=lambda path: told_turn(read_cloud(path).points),
    )
    if isinstance(moves, Trajectory) and timed:
        if odometry is not None:
            check_reach(odometry, moves, stamps)
        events += map(OdometryReading, moves.stamps_ns.tolist(), moves.poses)
    elif moved_by is not None and moves is not None:
        events += map(OdometryReading, stamps, scans.in_order(moved_by, moves))
    if odometry is not None:
        notes.append(taken_from(odometry, len(events) - len(paths)))
    elif world_T_body is not None and moved_by is None:
        notes.append(_no_odometry(posed_by))
    return Log(in_order(events), folder, notes, odometry_source=odometry)


def read_e57_log(path: Path, name: str, sensor: Sensor) -> Log:
    """Read the scans of an E57 file, one second each, with their poses where one has any."""
    clouds, grid = read_e57_scans(path), grid_of(sensor)
    poses = _of_body([cloud.world_T_sensor for cloud in clouds], sensor)
    told = [None] * len(clouds) if poses is None else poses
    events: list[Event] = [
        CloudScan(index * SCAN_PERIOD_NS, name, arrange(cloud.points, grid), pose, told_turn(cloud.points))
        for index, (cloud, pose) in enumerate(zip(clouds, told, strict=True))
    ]
    return Log(events, path, [] if poses is None else [_no_odometry(None)])


def _order(path: Path) -> tuple[list[tuple[int, str]], str]:
    """Names in the order of their numbers: 2 before 10."""
    parts = re.split(r"(\d+)", path.stem)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts], path.name


def _no_odometry(posed_by: Path | None) -> str:
    if posed_by is None:
        return "no odometry: the scans' own poses are not taken for it"
    return f"no odometry: the poses of {posed_by.name} are not taken for it (for slam: --odometry {posed_by.name})"


def _rows_of(path: Path | None) -> Trajectory | FloatArray | None:
    """TUM as a trajectory, KITTI as poses (N, 4, 4), by the number of words in a row; None: no such file."""
    if path is None:
        return None
    if path.suffix == ".txt" and len(next(iter(numbered_words(path)), (0, []))[1]) == 12:
        return read_kitti(path)
    return read_tum(path)


def _of_body(told: list[FloatArray | None], sensor: Sensor) -> FloatArray | None:
    """world_T_body (N, 4, 4) by poses of a sensor, of which those not told are the identity; None: not one is told."""
    if all(pose is None for pose in told):
        return None
    return np.array([np.eye(4) if pose is None else pose for pose in told]) @ inverse(sensor.body_T_sensor)


def _stamps(folder: Path, paths: list[Path], clocks: list[Trajectory]) -> tuple[list[int], bool]:
    """Time of every cloud, ns, and whether clouds or a list of times tell them."""
    if (folder / _TIMES).is_file():
        times, _, _ = read_rows(folder / _TIMES, columns=1, stamp_columns=1)
        if len(times) != len(paths):
            raise LogError(folder / _TIMES, f"expected {len(paths)} times, one for each cloud, got {len(times)}")
        return times[:, 0].tolist(), True
    named = [stamp for path in paths if (stamp := _time_in(path.stem)) is not None]
    if len(named) == len(paths):
        return named, True
    clock = next((rows for rows in clocks if len(rows) == len(paths)), None)
    return [k * SCAN_PERIOD_NS for k in range(len(paths))] if clock is None else clock.stamps_ns.tolist(), False


def _time_in(stem: str) -> int | None:
    """The time that a name tells, ns."""
    numbers = re.findall(r"\d+(?:\.\d+)?", stem)
    if len(numbers) != 1:
        return None
    (word,) = numbers
    if "." in word:
        with suppress(ValueError):
            return nanoseconds(word)
        return None
    return int(word) * _DIGITS_NS[len(word)] if len(word) in _DIGITS_NS and word[0] != "0" else None


def has_clouds(folder: Path, *, surely: bool) -> bool:
    """Whether a folder is one of clouds; `surely`: of a format that nothing else comes in."""
    found, _ = clouds_in(folder)
    return bool(found) and not (surely and found[0].suffix.lower() in _AMBIGUOUS)


def write_cloud_folder(log: Log, folder: Path | str) -> None:
    """Write a log of one 3D sensor and odometry into a folder that exists.

    It gets `clouds/000000.pcd` and so on, `times.txt`, and `odometry.tum` and `poses.tum` where the log has them.
    Points and times read back as they were, rotations to rounding error. Equal logs give equal bytes. A ValueError
    refuses logs of no 3D scan, 2D scans or two sensors, or of some scans with a pose of the robot and some without.
    """
    folder, scans = Path(folder), [scan for scan in log.scans() if isinstance(scan, CloudScan)]
    names = {scan.sensor for scan in log.scans()}
    if len(scans) != len(log.scans()) or len(names) != 1:
        raise ValueError(f"log: expected scans of one 3D sensor, got those of {', '.join(sorted(names)) or 'none'}")
    if len({scan.world_T_body is None for scan in scans}) != 1:
        raise ValueError("log: expected a pose of the robot with every scan or with none, got some")
    (folder / "clouds").mkdir()
    for index, scan in enumerate(scans):
        write_pcd(folder / "clouds" / f"{index:06d}.pcd", scan.points)
    stamps = [scan.stamp_ns for scan in scans]
    (folder / "times.txt").write_bytes("".join(seconds_from_ns(stamp) + "\n" for stamp in stamps).encode("ascii"))
    driven = [one.stamp_ns for one in log.odometry], [one.odom_T_body for one in log.odometry]
    told = stamps, [one.world_T_body for one in scans if one.world_T_body is not None]
    for name, (times, poses) in (("odometry.tum", driven), ("poses.tum", told)):
        if poses:
            write_tum(folder / name, Trajectory(np.array(times, dtype=np.int64), np.array(poses)))
