"""Folders of depth images: `intrinsics.txt`, the images in it or in its folder `depth`, times and poses beside them.

`depth.txt` or `associations.txt` lists images with their times as TUM RGB-D does; without a list all images are read,
in the order of the numbers in their names, at 30 Hz. `groundtruth.txt` or `poses.tum` holds the poses of the camera,
which `map` takes; `odometry.tum` odometry of the body, which `slam` takes: poses are no odometry.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path

import numpy as np

from slam.errors import LogError
from slam.geometry.frames import inverse
from slam.io._numbers import nanoseconds, numbered_words
from slam.io.clouds.depth import INTRINSICS, Camera, read_depth_image, read_intrinsics
from slam.io.folders.scan_files import ScanFiles, first_file
from slam.io.odometry_file import in_order, readings_of
from slam.io.trajectories import read_tum
from slam.sensors.log import Log
from spplanes._check import FloatArray

#: body_T_sensor of a camera that looks ahead: its z forward, its x to the right.
CAMERA_MOUNT = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
#: Name of the sensor where no rig gives one.
SENSOR = "camera"
#: Time between images that have no clock, ns.
PERIOD_NS = 33_333_333
_LISTS, _ODOMETRY = ("depth.txt", "associations.txt"), "odometry.tum"
#: Names of a file of the camera's poses.
CAMERA_POSES = ("groundtruth.txt", "poses.tum")


def is_depth_folder(folder: Path) -> bool:
    """Whether a folder holds depth images with their intrinsics."""
    return (folder / INTRINSICS).is_file() and bool(_images(folder))


def read_depth_folder(folder: Path, *, sensor: str = SENSOR, body_T_sensor: FloatArray | None = None) -> Log:
    """Read a folder of depth images; the images stay in their files until they are asked for.

    Args:
        folder: with the names above.
        sensor: name of the camera in the rig.
        body_T_sensor: where it sits, shape (4, 4): the poses are the camera's; None: as `CAMERA_MOUNT`.

    Raises:
        LogError: no images, a list that names others, intrinsics or poses that are wrong.
    """
    camera, mount = read_intrinsics(folder / INTRINSICS), CAMERA_MOUNT if body_T_sensor is None else body_T_sensor
    images = _images(folder)
    for path, _ in images:
        if not _is_there(path):
            raise LogError(
                path.parent / path.name[:60], "expected the depth image that the list names, found no such file"
            )
    stamps = [k * PERIOD_NS if stamp is None else stamp for k, (_, stamp) in enumerate(images)]
    scans = ScanFiles(folder, "image", [path for path, _ in images], stamps, images[0][1] is not None, numbered=False)
    truth = first_file(folder, CAMERA_POSES)
    poses = None if truth is None else scans.poses(truth, read_tum(truth)) @ inverse(mount)
    events = scans.events(sensor, partial(_points_of, camera=camera), poses)
    if (folder / _ODOMETRY).is_file():
        return Log(in_order([*readings_of(folder / _ODOMETRY, events), *events]), folder)
    notes = [] if truth is None else [f"no odometry: the poses of {truth.name} are not taken for it"]
    return Log(events, folder, notes)


def _is_there(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name too long for any file
        return False


def _points_of(path: Path, camera: Camera) -> FloatArray:
    return read_depth_image(path, camera).points


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
        if pair is None:
            raise ValueError("too few words")
        return path.parent / pair[1], nanoseconds(pair[0])
    except ValueError as error:
        raise LogError(path, f"expected a time and a file, got {' '.join(words)[:60]!r}", line=number) from error


def _by_number(path: Path) -> tuple[list[int], str]:
    return [int(digits) for digits in re.findall(r"\d+", path.stem)], path.name
