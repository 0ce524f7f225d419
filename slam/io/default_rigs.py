"""Rigs for logs that come with none: what to expect of sensors nobody describes."""

from __future__ import annotations

import numpy as np

from slam.errors import LogError
from slam.io.cloud_folders import SENSOR as CLOUD_SENSOR
from slam.io.clouds.depth import CAMERA_MOUNT
from slam.io.clouds.depth import SENSOR as CAMERA
from slam.io.rosbags.reader import Topics
from slam.sensors.log import CloudScan, LaserScan, Log
from slam.sensors.rig import LocalisationNoise, Mount, Rig, Sensor
from slam.sensors.scan_noise import TYPICAL_BEAM_SIGMA_M, shown_by_lines, with_beam_sigma
from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS, OdometryNoise
from spplanes._check import FloatArray

#: Odometry of a body that carries a 3D sensor and of which nothing else is known.
MEASURED = OdometryNoise(
    along_sigma_m_per_sqrt_m=0.1,
    lateral_sigma_m_per_sqrt_m=0.1,
    heading_sigma_rad_per_sqrt_m=0.02,
    z_sigma_m=0.05,
    pitch_sigma_rad=0.02,
    roll_sigma_rad=0.02,
)


def threedtk_rig() -> Rig:
    """A rig for 3DTK folders: a tilting SICK, and poses that come from odometry with a tilt estimate.

    Beams scatter by 10 mm about small patches. The servo that tilts the laser lags and catches up: on floor and ceiling
    the angle errs by 0.7 deg rms, a sawtooth 15 to 25 lines long that no number of beams averages out and that no two
    scans share. Walls, which hardly feel it, leave 10 mm; fronts of windows and doors are as rough as 40 mm. With these
    sigmas the NIS of plane factors on the corridor set is 1.0 per degree of freedom. Ranges below 0.5 m are the robot,
    or read centimetres short. The motion sigmas cover, axis by axis, the distance between that set's initial poses and
    its two registrations.
    """
    scanner = Sensor(
        kind="cloud",
        range_sigma_m=0.01,
        range_min_m=0.55,
        range_max_m=32.0,
        surface_sigma_m=0.01,
        surface_correlation_m=0.45,
        rough_sigma_m=0.04,
        tilt_sigma_rad=0.012,
        tilt_correlation_lines=20,
    )
    odometry = OdometryNoise(
        along_sigma_m_per_sqrt_m=0.04,
        lateral_sigma_m_per_sqrt_m=0.03,
        heading_sigma_rad_per_sqrt_m=0.01,
        z_sigma_m=0.05,
        pitch_sigma_rad=0.02,
        roll_sigma_rad=0.01,
    )
    return Rig(sensors={CLOUD_SENSOR: scanner}, odometry=odometry)


def cloud_rig() -> Rig:
    """A rig for clouds nobody describes: a 3D scanner at the body's origin, and odometry that knows little.

    Points of real scanners scatter by 10 to 20 mm about the planes of halls and rooms, and their surfaces are not flat
    to less than that; below half a metre there is the robot. Planes of one scan share an error of 3 mm and 0.05 deg:
    with twice as much, and more, the map of a hall came out less sharp, without any there were more planes twice.
    Odometry may be a guess: that of a room was 0.68 m off after 1.93 m.
    """
    scanner = Sensor(
        kind="cloud",
        range_sigma_m=0.02,
        range_min_m=0.5,
        range_max_m=200.0,
        surface_sigma_m=0.02,
        surface_correlation_m=0.5,
        plane_sigma_m=0.003,
        plane_sigma_rad=0.0009,
    )
    guess = {
        "along_sigma_m_per_sqrt_m": 0.35,
        "lateral_sigma_m_per_sqrt_m": 0.35,
        "heading_sigma_rad_per_sqrt_m": 0.05,
    }
    odometry = MEASURED.model_copy(update=guess)
    # poses that others estimated: 1 to 2 cm and 0.1 deg
    poses = LocalisationNoise(xy_sigma_m=0.01, heading_sigma_rad=0.001, z_sigma_m=0.01, tilt_sigma_rad=0.001)
    return Rig(sensors={CLOUD_SENSOR: scanner}, odometry=odometry, localisation=poses)


def turned_laser_rig() -> Rig:
    """A rig for clouds whose order shows the lines of a 2D laser that something turned, such as a robot on the spot.

    Its angles err, lines near each other alike: ceilings and walls of a room were 1 to 20 mm and 0.2 to 3 deg off as
    seen from two places.
    """
    clouds = cloud_rig()
    turned = clouds.sensors[CLOUD_SENSOR].model_copy(update={"plane_sigma_rad": 0.0044})
    return clouds.model_copy(update={"sensors": {CLOUD_SENSOR: turned}})


def depth_rig() -> Rig:
    """A rig for depth cameras nobody describes: looking ahead, with the noise of a Kinect.

    It grows with the square of the depth: 1.4 mm/m^2, and steps of 2.9 mm/m^2 (an eighth of a pixel of disparity, 580
    pixels of focal length, 75 mm between projector and camera). It bends planes: in 58 images of a cabinet (TUM
    fr3_cabinet) angles between the same planes differ by 0.56 deg rms, by 0.50 deg once that is taken off
    (`slam.frontend.warp_calibration`); the height of its top by 3.7 mm.
    """
    camera = Sensor(
        kind="cloud",
        body_T_sensor=Mount.of(CAMERA_MOUNT),
        range_sigma_m=0.0015,
        disparity_sigma_per_m=0.0014,
        disparity_step_per_m=0.0029,
        range_min_m=0.3,
        range_max_m=5.0,
        surface_sigma_m=0.01,
        plane_sigma_m=0.003,
        plane_sigma_rad=0.006,
    )
    return Rig(sensors={CAMERA: camera}, odometry=MEASURED, localisation=cloud_rig().localisation)


#: Flatness taken for walls nobody describes, m.
_SURFACE_SIGMA_M = 0.008


def default_rig_for(log: Log) -> Rig:
    """A rig for a log that comes with none: every 2D laser in it sees lines, unless the log says that it is not level.

    Lasers sit where the log says, else at the robot's centre; the step of the ranges is found in the ranges.
    """
    scans: dict[str, list[LaserScan]] = {}
    for scan in log.scans():
        if isinstance(scan, LaserScan):
            scans.setdefault(scan.sensor, []).append(scan)
    if not scans:
        raise LogError(log.source, "expected laser scans, got none")
    lasers = {name: _default_laser(name, own, log.mounts.get(name)) for name, own in scans.items()}
    return Rig(sensors=lasers, odometry=UNCALIBRATED_WHEELS)


def _default_laser(name: str, scans: list[LaserScan], told: FloatArray | None) -> Sensor:
    steps, largest = [0.1, 0.05, 0.01, 0.005, 0.001], 0.0  # those that lasers use, m
    for scan in scans:
        seen = scan.ranges[np.isfinite(scan.ranges)]
        steps = [step for step in steps if (np.abs(seen / step - np.rint(seen / step)) <= 1e-3).all()]
        largest = max(largest, float(seen.max(initial=0.0)))
    sensor = Sensor(
        kind="line" if told is None or abs(told[2, 2]) > 0.97 else "slice",  # up to 14 deg off level it sees lines
        record=name,
        body_T_sensor=_default_mount(name, told),
        range_sigma_m=TYPICAL_BEAM_SIGMA_M,
        quantisation_m=max(steps, default=0.0) if largest else 0.0,
        range_max_m=largest + 0.01 if largest else 80.0,
        surface_sigma_m=_SURFACE_SIGMA_M,
        surface_correlation_m=0.5,  # a patch that shares one deviation: skirting, door frames, what leans on walls
    )
    seen_m = shown_by_lines(sensor, scans) or TYPICAL_BEAM_SIGMA_M
    # half of what beams scatter by is taken to be alike over a patch: a laser that measures worse repeats more as well
    uneven = float(np.hypot(_SURFACE_SIGMA_M, 0.5 * seen_m))
    return with_beam_sigma(sensor.model_copy(update={"surface_sigma_m": uneven}), seen_m)


def _default_mount(name: str, told: FloatArray | None) -> Mount:
    """The mount the log tells; else the robot's centre, a rear laser looking back."""
    if told is None:
        return Mount(rpy_deg=(0.0, 0.0, 180.0 if name == "RLASER" else 0.0))
    is_level = np.abs(told[2, :2]).max() < 1e-9 and told[2, 2] > 0.0  # it only turns about z
    if not is_level:
        return Mount.of(told)
    yaw_deg = float(np.rad2deg(np.arctan2(told[1, 0], told[0, 0])))
    return Mount(xyz_m=(float(told[0, 3]), float(told[1, 3]), float(told[2, 3])), rpy_deg=(0.0, 0.0, yaw_deg))


def bag_rig(log: Log, topics: Topics) -> Rig:
    """A rig for a bag: mounts from tf; lasers by `default_rig_for`, clouds as in `cloud_rig`."""
    clouds, sensors = cloud_rig(), {}
    for name in dict.fromkeys(scan.sensor for scan in log.scans() if isinstance(scan, CloudScan)):
        mount = log.mounts.get(name)
        update = {"record": name, "mount": Mount() if mount is None else Mount.of(mount)}
        sensors[name] = clouds.sensors[CLOUD_SENSOR].model_copy(update=update)
    if any(isinstance(scan, LaserScan) for scan in log.scans()):
        sensors |= default_rig_for(log).sensors
    seen_in_3d = any(sensor.kind == "cloud" for sensor in sensors.values())
    return Rig(
        sensors=sensors,
        odometry=MEASURED if seen_in_3d else UNCALIBRATED_WHEELS,
        odometry_record=topics.odometry,
        odometry_frame=topics.odometry_frame,
        body_frame=topics.body_frame,
    )


#: What a sensor of each kind is called.
_KINDS = {"line": "a level 2D laser", "slice": "a push-broom 2D laser", "cloud": "a 3D sensor"}


def assumptions(log: Log, rig: Rig) -> list[str]:
    """What a rig that nobody gave takes for granted, one sentence for each of its sensors."""
    return [f"no rig: {name} is taken for {_taken_for(name, sensor, log)}" for name, sensor in rig.sensors.items()]


def _taken_for(name: str, sensor: Sensor, log: Log) -> str:
    is_cloud = sensor.kind == "cloud"
    noise = f"{1000.0 * (sensor.range_sigma_m if is_cloud else sensor.beam_sigma_m):.3g} mm of noise"
    if not is_cloud and not np.isclose(sensor.beam_sigma_m, TYPICAL_BEAM_SIGMA_M, rtol=1e-9, atol=0.0):
        shared = f"{1000.0 * sensor.surface_sigma_m:.3g} mm of it alike over {sensor.surface_correlation_m:g} m of wall"
        noise += f", as its lines show, {shared}"  # where they do not, it is the typical one
    if sensor.disparity_sigma_per_m:
        noise += f" and {1000.0 * sensor.disparity_sigma_per_m:g} mm times the square of the range in m"
    if name in log.mounts:
        return f"{_KINDS[sensor.kind]} with {noise}, mounted as the log says"
    turned = not np.allclose(sensor.body_T_sensor[:3, :3], np.eye(3))
    looks = "looking ahead" if np.allclose(sensor.body_T_sensor, CAMERA_MOUNT) else "turned" if turned else "level"
    return f"{_KINDS[sensor.kind]} with {noise}, at the body's origin and {looks}: nobody says where it is mounted"
