"""A box on a floor as a depth camera sees it: two directions of planes, and edges that hold the third."""

import numpy as np

from slam.config import SlamConfig
from slam.frontend.measurement import ScanMeasurement, measured_cloud
from slam.frontend.scan_surfaces import ON_PLANE, SHARE_ON_PLANE
from slam.io.clouds.depth import Camera
from slam.sensors.log import CloudScan
from slam.sensors.rig import Mount, Sensor
from spplanes._check import FloatArray
from spplanes.spmodel import transform_from_rpy

#: Corners of the box, m.
LOW, HIGH = np.array([-0.4, -0.3, 0.0]), np.array([0.4, 0.3, 0.6])
CAMERA = Camera(130.0, 130.0, 79.5, 59.5)
#: z forward, x to the right.
MOUNT = np.array([[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
SENSOR = Sensor(
    kind="cloud",
    body_T_sensor=Mount.of(MOUNT),
    range_sigma_m=0.002,
    range_min_m=0.3,
    range_max_m=6.0,
    surface_sigma_m=0.002,
)


def looking(x: float, y: float, z: float, yaw: float, pitch: float) -> FloatArray:
    """world_T_body of a body that looks down by a pitch, rad."""
    return transform_from_rpy((x, y, z, yaw, pitch, 0.0))


def seen_from(world_T_body: FloatArray, rng: np.random.Generator, noise_m: float = 0.002) -> FloatArray:
    """Points (120, 160, 3) of the camera, in its own frame, with noise along the ray."""
    rays, world_T_camera = CAMERA.points(np.ones((120, 160))), world_T_body @ MOUNT
    directions, eye = rays @ world_T_camera[:3, :3].T, world_T_camera[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(directions[..., 2] < 0.0, -eye[2] / directions[..., 2], np.inf)
        near, far = (LOW - eye) / directions, (HIGH - eye) / directions
    first, last = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
    depth = np.where((first < last) & (first > 0.0), np.minimum(first, floor), floor)
    depth = np.where(depth < 6.0, depth, np.nan)
    noise = 1.0 + noise_m * rng.standard_normal(depth.shape) / (depth * np.linalg.norm(rays, axis=-1))
    return rays * (depth * noise)[..., None]


def measured(world_T_body: FloatArray, rng: np.random.Generator) -> ScanMeasurement:
    """Planes and surface elements of such an image."""
    return measured_cloud(CloudScan(0, "camera", seen_from(world_T_body, rng)), SENSOR, SlamConfig())


def with_widths(rows: np.ndarray) -> np.ndarray:
    """Surface elements (N, 9) by all but their widths (N, 8), which are those that dense scans have."""
    share = np.where(rows[:, 7] == ON_PLANE, SHARE_ON_PLANE, 0.03)
    return np.column_stack((rows, share * np.linalg.norm(rows[:, :3], axis=1)))
