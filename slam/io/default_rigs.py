"""Rigs for logs that come with none: what to expect of sensors nobody describes."""

from __future__ import annotations

from slam.io.depth_folder import CAMERA_MOUNT
from slam.io.depth_folder import SENSOR as CAMERA
from slam.io.folders import SENSOR as CLOUD_SENSOR
from slam.io.log import CloudScan, LaserScan, Log
from slam.io.rosbag import Topics
from slam.motion import UNCALIBRATED_WHEELS, OdometryNoise
from slam.rig import LocalisationNoise, Mount, Rig, Sensor, default_rig_for


def cloud_rig() -> Rig:
    """A rig for clouds nobody describes: a 3D scanner at the body's origin, and odometry that knows little.

    Points of real scanners scatter by 10 to 20 mm about the planes of halls and rooms, and their surfaces are not flat
    to less than that; below half a metre there is the robot.
    """
    scanner = Sensor(
        kind="cloud",
        range_sigma_m=0.02,
        range_min_m=0.5,
        range_max_m=200.0,
        surface_sigma_m=0.02,
        surface_correlation_m=0.5,
    )
    odometry = OdometryNoise(
        along_sigma_m_per_sqrt_m=0.1,
        lateral_sigma_m_per_sqrt_m=0.1,
        heading_sigma_rad_per_sqrt_m=0.02,
        z_sigma_m=0.05,
        pitch_sigma_rad=0.02,
        roll_sigma_rad=0.02,
    )
    # poses that others estimated: 1 to 2 cm and 0.1 deg
    poses = LocalisationNoise(xy_sigma_m=0.01, heading_sigma_rad=0.001, z_sigma_m=0.01, tilt_sigma_rad=0.001)
    return Rig(sensors={CLOUD_SENSOR: scanner}, odometry=odometry, localisation=poses)


def depth_rig() -> Rig:
    """A rig for depth cameras nobody describes: looking ahead, in the middle of a Kinect's noise (6 mm at 2 m)."""
    clouds = cloud_rig()
    camera = Sensor(
        kind="cloud",
        body_T_sensor=Mount(matrix=tuple(tuple(row) for row in CAMERA_MOUNT.tolist())),
        range_sigma_m=0.006,
        range_min_m=0.3,
        range_max_m=5.0,
        surface_sigma_m=0.01,
    )
    return Rig(sensors={CAMERA: camera}, odometry=clouds.odometry, localisation=clouds.localisation)


def bag_rig(log: Log, topics: Topics) -> Rig:
    """A rig for a bag: mounts from tf; lasers by `default_rig_for`, clouds as in `cloud_rig`."""
    clouds, sensors = cloud_rig(), {}
    for name in dict.fromkeys(scan.sensor for scan in log.scans() if isinstance(scan, CloudScan)):
        mount = log.mounts.get(name)
        rows = None if mount is None else tuple(tuple(row) for row in mount.tolist())
        update = {"record": name, "mount": Mount(matrix=rows) if rows else Mount()}
        sensors[name] = clouds.sensors[CLOUD_SENSOR].model_copy(update=update)
    if any(isinstance(scan, LaserScan) for scan in log.scans()):
        sensors |= default_rig_for(log).sensors
    seen_in_3d = any(sensor.kind == "cloud" for sensor in sensors.values())
    odometry = clouds.odometry if seen_in_3d else UNCALIBRATED_WHEELS
    return Rig(sensors=sensors, odometry=odometry, odometry_record=topics.odometry)
