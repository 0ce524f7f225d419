"""Depth images with the intrinsics of their camera.

`intrinsics.txt` lies beside the image, or one folder up: the (3, 3) matrix, or fx fy cx cy; a number more is the units
per metre of the image (else 5000, as in TUM RGB-D and ICL-NUIM). Points are in the camera's frame, x to the right, y
down (up where fy is negative), z forward.
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import inverse
from slam.io.clouds.cloud import Cloud, checked
from slam.io.raw import ascii_of, damage_told, nanoseconds, numbered_words, read_bytes, text_rows
from slam.io.scan_files import ScanFiles, first_file, in_order, readings_of, with_odometry
from slam.io.trajectories import read_tum
from slam.sensors.log import Log
from slam.sensors.rig import Sensor
from spplanes._check import FloatArray

INTRINSICS = "intrinsics.txt"
#: Units per metre of TUM RGB-D and ICL-NUIM.
USUAL_UNITS_PER_M = 5000.0
#: Larger images are refused before they are decoded, pixels.
MOST_PIXELS = 1 << 24


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: focal lengths (fy negative: y is up) and place of the optical axis, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float
    units_per_m: float = USUAL_UNITS_PER_M
    """What a depth of 1 m is in the images."""

    def points(self, depth: FloatArray) -> FloatArray:
        """Points (H, W, 3) of depths (H, W), m, in the camera's frame; NaN where the depth is 0 or NaN."""
        v, u = np.mgrid[: depth.shape[0], : depth.shape[1]]
        z = np.where(depth > 0.0, depth, np.nan)
        return np.stack(((u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z), axis=-1)


def read_depth_image(path: Path, camera: Camera | None = None) -> Cloud:
    """One depth image, 16 bits a pixel, as an organised cloud (H, W, 3).

    `camera`: None: that of intrinsics.txt beside the image or one folder up.
    """
    from PIL import Image

    camera = camera or _camera_of(path)
    if not path.is_file():
        raise LogError(path, "expected a depth image, found no such file")
    with damage_told(path, "expected a whole PNG, got one that cannot be read"):
        with Image.open(path) as image:
            if image.width * image.height > MOST_PIXELS:
                raise LogError(path, f"expected at most {MOST_PIXELS} pixels, got {image.width} x {image.height}")
            if image.mode not in ("I;16", "I;16B", "I", "L"):
                raise LogError(path, f"expected one channel of 8 or 16 bits, got the mode {image.mode}")
            depth = np.asarray(image, dtype=np.float64) / camera.units_per_m
        _check_whole(path)
    return replace(checked(path, camera.points(depth)), is_depth_image=True)


def _check_whole(path: Path) -> None:
    """Refuse a PNG with fewer pixels than it has room for: Pillow fills up with zeros what a stream that ends lacks."""
    data = read_bytes(path)
    width, height, bits, _, _, _, interlaced = struct.unpack(">IIBBBBB", data[16:29])
    row = (width * bits + 7) // 8
    wanted = height * (row if interlaced else row + 1)
    packed, place = b"", 8
    while place + 8 <= len(data):
        size, kind = struct.unpack(">I4s", data[place : place + 8])
        if kind == b"IDAT":
            packed += data[place + 8 : place + 8 + size]
        place += size + 12
    if len(zlib.decompressobj().decompress(packed, wanted)) < wanted:
        raise LogError(path, f"expected {height} rows of {width} pixels, got a PNG that ends before")


def read_intrinsics(path: Path) -> Camera:
    """Read fx fy cx cy, or a (3, 3) matrix, and perhaps the units per metre."""
    text = ascii_of(path, read_bytes(path)).replace("\n", " ").replace(",", " ")
    numbers = text_rows(path, text, None).ravel()
    if numbers.size in (4, 5):
        fx, fy, cx, cy = numbers[:4].tolist()
    elif numbers.size in (9, 10):
        fx, skew, cx, low, fy, cy, *last = numbers[:9].tolist()
        if (skew, low, *last) != (0.0, 0.0, 0.0, 0.0, 1.0):
            raise LogError(path, "expected a camera matrix (fx 0 cx, 0 fy cy, 0 0 1), got another")
    else:
        raise LogError(path, f"expected fx fy cx cy or a 3x3 matrix, perhaps with a scale, got {numbers.size} numbers")
    scale = float(numbers[-1]) if numbers.size in (5, 10) else USUAL_UNITS_PER_M
    if not np.isfinite(numbers).all() or fx == 0.0 or fy == 0.0 or scale <= 0.0:
        raise LogError(path, f"expected focal lengths and a scale that are not 0, got {fx:g}, {fy:g} and {scale:g}")
    return Camera(fx, fy, cx, cy, scale)


def _camera_of(path: Path) -> Camera:
    for place in (path.parent, path.parent.parent):
        if (place / INTRINSICS).is_file():
            return read_intrinsics(place / INTRINSICS)
    raise LogError(path, f"expected {INTRINSICS} (fx fy cx cy) beside the depth image, found none")


#: body_T_sensor of a camera that looks ahead: its z forward, its x to the right.
CAMERA_MOUNT = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
#: Name of the sensor where no rig gives one.
SENSOR = "camera"
_LISTS, _ODOMETRY = ("depth.txt", "associations.txt"), "odometry.tum"
#: Names of a file of the camera's poses.
CAMERA_POSES = ("groundtruth.txt", "poses.tum")


def is_depth_folder(folder: Path) -> bool:
    """Whether a folder holds depth images with their intrinsics."""
    return (folder / INTRINSICS).is_file() and bool(_images(folder))


def read_depth_folder(folder: Path, name: str, sensor: Sensor, odometry: Path | None = None) -> Log:
    """Read a folder of depth images; the images stay in their files until they are asked for.

    The poses beside them are those of `sensor`, the camera, which is called `name` in the rig; a file that is given for
    odometry and is one of the camera's poses by its name is moved to the body.
    """
    camera, mount = read_intrinsics(folder / INTRINSICS), sensor.body_T_sensor
    paths, told = zip(*_images(folder), strict=True)
    for path in paths:
        if not os.path.isfile(path):  # False for a name too long for any file, too
            named = path.parent / path.name[:60]
            raise LogError(named, "expected the depth image that the list names, found no such file")
    stamps = [k * 33_333_333 if stamp is None else stamp for k, stamp in enumerate(told)]  # without a clock 30 a second
    scans = ScanFiles(folder, "image", list(paths), stamps, told[0] is not None, numbered=False)
    truth = first_file(folder, CAMERA_POSES)
    poses = None if truth is None else scans.poses(truth, read_tum(truth)) @ inverse(mount)
    events = scans.events(name, poses, points=lambda path: read_depth_image(path, camera).points)
    if (folder / _ODOMETRY).is_file():
        log = Log(in_order([*readings_of(folder / _ODOMETRY, events), *events]), folder)
    else:
        notes = [] if truth is None else [f"no odometry: the poses of {truth.name} are not taken for it"]
        log = Log(events, folder, notes)
    if odometry is not None and odometry.name in CAMERA_POSES:
        return with_odometry(log, odometry, mount)
    return log


def _images(folder: Path) -> list[tuple[Path, int | None]]:
    """Images with their times, ns: those of a list, else all, by name."""
    listed = first_file(folder, _LISTS)
    if listed is not None:
        return [_listed(listed, number, words) for number, words in numbered_words(listed)]
    for place in (folder, folder / "depth"):
        found = sorted(place.glob("*.png"), key=_by_number) if place.is_dir() else []
        if found:
            return [(path, None) for path in found]
    return []


def _listed(path: Path, number: int, words: list[str]) -> tuple[Path, int]:
    """A line `t file`, or `t rgb t depth`: the pair whose file is in a folder depth, else the first."""
    pairs = list(zip(words[::2], words[1::2], strict=False))
    pair = next((pair for pair in pairs if "depth" in pair[1]), pairs[0] if pairs else None)
    try:
        stamp, name = pair or ("", "")
        return path.parent / name, nanoseconds(stamp)
    except ValueError as error:
        raise LogError(path, f"expected a time and a file, got {' '.join(words)[:60]!r}", line=number) from error


def _by_number(path: Path) -> tuple[list[int], str]:
    return [int(digits) for digits in re.findall(r"\d+", path.stem)], path.name
