"""Reader of 3DTK scan folders: `scanNNN.3d` (or `.3d.gz`) with `scanNNN.pose`.

3DTK is left-handed and in centimetres: x right, y up, z forward. This project is right-handed and in metres:
x forward, y left, z up. A point goes over as p = C q / 100 with C below, a transform as C T C^-1.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam.errors import LogError
from slam.io.cloud_folders import SCAN_PERIOD_NS, SENSOR
from slam.io.clouds.cloud import FARTHEST_M
from slam.io.raw import ascii_of, floats_of, line_named, numbered_words, read_unpacked, text_rows
from slam.sensors.log import CloudScan, Event, Log, OdometryReading
from spplanes._check import FloatArray

#: Ranges beyond this are the scanner's "no return", m.
NO_RETURN_M = 32.0
#: right-handed axes from left-handed ones.
AXES = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
METRES_PER_UNIT = 0.01

_SCAN_NAME = re.compile(r"scan(\d+)\.3d(\.gz)?$")


def is_3dtk_folder(path: Path) -> bool:
    """Whether a folder holds 3DTK scans."""
    return path.is_dir() and any(map(is_3dtk_scan, path.iterdir()))


def is_3dtk_scan(path: Path) -> bool:
    """Whether the name is that of a scan of 3DTK."""
    return _SCAN_NAME.match(path.name) is not None


def read_3dtk(folder: Path) -> Log:
    """Read a folder of 3DTK scans in the order of their numbers.

    Returns:
        Organised scans of shape (lines, beams, 3) where the lines of the scanner can be told apart, NaN = no return,
        each with the pose of its `.pose` file as odometry.

    Raises:
        LogError: a missing or unreadable file, a line that is not three numbers, a scan without a return.
    """
    folder = Path(folder)
    scans = sorted((int(match[1]), path) for path in folder.iterdir() if (match := _SCAN_NAME.match(path.name)))
    if not scans:
        raise LogError(folder, "expected files named scanNNN.3d or scanNNN.3d.gz, found none")
    events: list[Event] = []
    for order, (_, path) in enumerate(scans):
        stamp_ns = order * SCAN_PERIOD_NS
        odom_T_body = read_pose(path.with_name(path.name.split(".")[0] + ".pose"))
        events.append(OdometryReading(stamp_ns, odom_T_body))
        events.append(CloudScan(stamp_ns, SENSOR, read_points(path)))
    return Log(events, folder, ["odometry: the initial poses of the .pose files, as 3DTK has them"])


def read_pose(path: Path) -> FloatArray:
    """odom_T_body, shape (4, 4), from a `.pose` file: x y z in cm, then rotations about x, y, z in degrees."""
    if not path.is_file():
        raise LogError(path, "expected the pose of the scan beside it, found no such file")
    values = []
    for line, words in numbered_words(path):
        with line_named(path, line):
            values += floats_of(words)
    if len(values) != 6:
        raise LogError(path, f"expected six numbers (x y z rx ry rz), got {len(values)}")
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_euler("XYZ", values[3:], degrees=True).as_matrix()  # Rx Ry Rz
    transform[:3, 3] = values[:3]
    return to_right_handed(transform)


def read_points(path: Path) -> FloatArray:
    """Points of one scan, m, right-handed; shape (lines, beams, 3) if organised, else (1, N, 3)."""
    raw = text_rows(path, ascii_of(path, read_unpacked(path)), 3, finite=True)
    if not len(raw):
        raise LogError(path, "expected lines of three numbers, got an empty file")
    raw = np.where(np.abs(raw) < FARTHEST_M, raw, FARTHEST_M)
    beams = beams_per_line(raw)
    points = raw @ AXES.T * METRES_PER_UNIT
    ranges = np.linalg.norm(points, axis=1)
    points[(ranges > NO_RETURN_M) | (ranges <= 0.0)] = np.nan
    if not np.isfinite(points).any():
        raise LogError(path, f"expected at least one return within {NO_RETURN_M:g} m, got none")
    return points.reshape(-1, beams, 3)


def beams_per_line(points: FloatArray) -> int:
    """Beams of one scanner line: the distance between the jumps back of the bearing, if it divides the scan evenly.

    The lines of a scanner that tilts about 3DTK's x axis sweep from one end of that axis to the other, whatever the
    tilt; so the angle to the x axis moves one way inside a line and jumps back between lines.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        bearing = np.arccos(np.clip(points[:, 0] / np.linalg.norm(points, axis=1), -1.0, 1.0))
    step = np.diff(bearing)
    if not np.isfinite(step).any():
        return len(points)
    direction = np.sign(np.nanmedian(step))
    back = np.flatnonzero(direction * step < -np.pi / 2.0) + 1
    lengths = np.unique(np.diff(np.concatenate(([0], back, [len(points)]))))
    return int(lengths[0]) if len(lengths) == 1 else len(points)


def to_right_handed(transform: FloatArray) -> FloatArray:
    """Transform (4, 4) in 3DTK's axes and centimetres to this project's axes and metres."""
    result = np.eye(4)
    result[:3, :3] = AXES @ transform[:3, :3] @ AXES.T
    result[:3, 3] = AXES @ transform[:3, 3] * METRES_PER_UNIT
    return result


def read_frames(path: Path) -> FloatArray:
    """Final transform of a `.frames` file, shape (4, 4), right-handed, m: the registration's answer for the scan."""
    lines = numbered_words(path)
    if not lines:
        raise LogError(path, "expected at least one transform, got an empty file")
    number, last = lines[-1]
    with line_named(path, number):
        values = floats_of(last)
        if len(values) < 16:
            raise ValueError(f"expected 16 numbers of a 4x4 transform, got {len(values)}")
    return to_right_handed(np.array(values[:16]).reshape(4, 4, order="F"))
