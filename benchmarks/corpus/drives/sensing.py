"""Sensor suites of random drives: which beams, where they sit, how they err, how often they look."""

from dataclasses import dataclass

import numpy as np

from slam.io.clouds.depth import CAMERA_MOUNT, Camera
from slam.io.default_rigs import depth_rig
from slam.sensors.rig import Mount, Sensor
from slam.simulation.record import noisy_ranges
from slam.simulation.robots import BEAMS, HORIZONTAL, SPINNING, VERTICAL, Beams, paper_rig, spinning_rig
from spplanes._check import FloatArray
from spplanes.noise import DepthCameraModel

#: Names of the sensors that `rigs` does not have.
LIDAR, CAMERA = "lidar", "camera"
#: Steps of azimuth of a spinning lidar.
_STEPS = 900
#: Image of the depth camera: rows, columns, focal length in pixels (a Kinect's, every fourth pixel).
_ROWS, _COLUMNS, _FOCAL = 120, 160, 145.0
#: Way between two scans, m: of the paper's lasers as there, of lidars, of depth images.
_SLICES_M, _LINES_M, _CLOUDS_M, _IMAGES_M = 0.027, 0.108, 0.5, 0.25
#: Standard deviations of the depths of a Kinect, m.
depth_sigma = DepthCameraModel().depth_sigma


@dataclass(frozen=True, eq=False)
class Sensing:
    """One sensor on the robot, as it really is."""

    name: str
    sensor: Sensor  # what it is; its sigma is the true one, unless the beams err by depth
    beams: Beams
    every_m: float  # way between two scans, m
    late_m: float = 0.0  # way before the first scan, m
    turn_s: float = 0.0  # time of a turn of a lidar, in whose middle a cloud is stamped; the rig says nothing of it
    by_depth: bool = False  # whether the noise grows with depth, as of a structured-light camera

    def read(self, ranges: FloatArray, rng: np.random.Generator) -> FloatArray:
        """What it reads of exact ranges (S, F B), m; NaN = no return."""
        if not self.by_depth:
            return noisy_ranges(ranges, self.sensor, rng)
        ahead = self.beams.directions[..., 2].ravel()
        depth = np.where(np.isfinite(ranges), ranges, 1e3) * ahead
        read = depth + depth_sigma(depth) * rng.standard_normal(ranges.shape)
        seen = (read > self.sensor.range_min_m) & (read < self.sensor.range_max_m)
        return np.where(seen, read / ahead, np.nan)


def _level() -> Sensing:
    sensor = paper_rig().sensors[HORIZONTAL]
    return Sensing(HORIZONTAL, sensor, Beams.of_laser(np.deg2rad(np.arange(-270, 271) * 0.5)), _LINES_M)


def _paper() -> list[Sensing]:
    sensors = paper_rig().sensors
    level = Sensing(HORIZONTAL, sensors[HORIZONTAL], BEAMS[HORIZONTAL], _LINES_M, _SLICES_M / 2.0)
    return [level, Sensing(VERTICAL, sensors[VERTICAL], BEAMS[VERTICAL], _SLICES_M)]


def _lidar(rings: int, lowest_deg: float, highest_deg: float, turn_s: float = 0.0) -> Sensing:
    sensor, turns = spinning_rig().sensors[SPINNING], np.linspace(-np.pi, np.pi, _STEPS, endpoint=False)
    beams = Beams.of_spinning(turns, np.deg2rad(np.linspace(lowest_deg, highest_deg, rings)))
    return Sensing(LIDAR, sensor, beams, _CLOUDS_M, turn_s=turn_s)


def camera_beams(rows: int, columns: int, focal_pixels: float) -> Beams:
    """Of a pinhole camera that looks along z, a fan of `columns` beams for every row of its image."""
    camera = Camera(focal_pixels, focal_pixels, (columns - 1) / 2, (rows - 1) / 2)
    directions = camera.points(np.ones((rows, columns)))
    normals = np.cross(directions[:, 0], directions[:, -1])
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return Beams(directions, normals / np.linalg.norm(normals, axis=1, keepdims=True), None)


def _camera() -> Sensing:
    matrix = CAMERA_MOUNT.copy()
    matrix[:3, 3] = (0.1, 0.0, 1.0)
    (described,) = depth_rig().sensors.values()
    sensor = described.model_copy(update={"mount": Mount.of(matrix)})
    return Sensing(CAMERA, sensor, camera_beams(_ROWS, _COLUMNS, _FOCAL), _IMAGES_M, by_depth=True)


#: Sensor suites.
SENSORS: dict[str, list[Sensing]] = {
    "level": [_level()],
    "paper": _paper(),
    "pushbroom": _paper()[1:],
    "lidar16": [_lidar(16, -15.0, 15.0)],
    "lidar32": [_lidar(32, -30.0, 30.0)],
    "lidar64": [_lidar(64, -30.0, 30.0)],
    "turning16": [_lidar(16, -15.0, 15.0, 0.1)],
    "turning32": [_lidar(32, -30.0, 30.0, 0.1)],
    "depth": [_camera()],
}
