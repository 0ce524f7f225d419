"""The two simulated robots: the paper's with its 2D lasers, and one with a spinning 3D laser."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.sensors.rig import LocalisationNoise, Mount, OdometryNoise, Rig, Sensor
from spplanes._check import FloatArray
from spplanes.registration import beam_directions

#: Names of the sensors: the paper's two lasers, and the spinning one.
HORIZONTAL, VERTICAL, SPINNING = "horizontal", "vertical", "spinning"


#: The floors of the simulated worlds are level, and the robots neither pitch nor roll: a rig that said otherwise would
#: make every map look more cautious than it is.
ON_LEVEL_FLOOR = OdometryNoise(z_sigma_m=1e-4, pitch_sigma_rad=1e-4, roll_sigma_rad=1e-4)


@dataclass(frozen=True, eq=False)
class Beams:
    """Directions of the beams of a sensor, in fans that each lie in one plane."""

    directions: FloatArray
    """Unit directions in the sensor frame, shape (F, B, 3): F fans of B beams."""
    normals: FloatArray
    """Normal of each fan's plane, shape (F, 3)."""
    angles: FloatArray | None
    """Bearings of the one fan of a 2D laser, shape (B,), rad; None for a 3D one."""

    @classmethod
    def of_laser(cls, angles: FloatArray) -> Beams:
        """A 2D laser with bearings (B,), rad."""
        return cls(beam_directions(angles)[None], np.array([[0.0, 0.0, 1.0]]), angles)

    @classmethod
    def of_spinning(cls, azimuths: FloatArray, elevations: FloatArray) -> Beams:
        """A 3D laser: at each azimuth (F,) a fan of elevations (B,), rad."""
        c, s = np.cos(azimuths)[:, None], np.sin(azimuths)[:, None]
        level, rise = np.cos(elevations), np.sin(elevations)
        directions = np.stack([c * level, s * level, np.broadcast_to(rise, (len(azimuths), len(elevations)))], axis=-1)
        return cls(directions, np.column_stack([s, -c, np.zeros_like(c)]), None)


#: 361 beams over 180 deg as in the paper; its two opposing horizontal lasers as one of 360 deg; 32 rings.
BEAMS = {
    VERTICAL: Beams.of_laser(np.deg2rad(np.arange(-240, 121) * 0.5)),
    HORIZONTAL: Beams.of_laser(np.deg2rad(np.arange(-360, 360) * 0.5)),
    SPINNING: Beams.of_spinning(np.deg2rad(np.arange(-180.0, 180.0)), np.deg2rad(np.linspace(-30.0, 60.0, 32))),
}


def paper_rig() -> Rig:
    """The robot of the paper: a level 360 deg laser for lines, a vertical push-broom laser for 3D, drifting wheels.

    The vertical laser scans the plane across the robot, 0.4 m above the floor: its x axis points up, y to the left.
    Its 180 deg are turned 30 deg to the right (bearings -120 to 60 deg), so that they reach from a strip of floor on
    the right over the ceiling to the upper left wall: all four sides of a corridor in every scan.
    """
    noise: dict[str, Any] = {"range_sigma_m": 0.015, "range_max_m": 40.0}
    level = Mount(xyz_m=(0.0, 0.0, 0.3))
    upright = Mount(xyz_m=(0.0, 0.0, 0.4), rpy_deg=(0.0, -90.0, 0.0))
    return Rig(
        sensors={
            HORIZONTAL: Sensor(kind="line", body_T_sensor=level, record="ROBOTLASER1", **noise),
            VERTICAL: Sensor(kind="slice", body_T_sensor=upright, record="ROBOTLASER2", **noise),
        },
        odometry=ON_LEVEL_FLOOR,
        localisation=LocalisationNoise(),
    )


def spinning_rig() -> Rig:
    """A robot with a 3D laser 0.8 m above the floor: 32 rings from -30 to 60 deg, 1 deg in azimuth, sigma 15 mm."""
    mount = Mount(xyz_m=(0.1, 0.0, 0.8))
    sensor = Sensor(kind="cloud", body_T_sensor=mount, range_sigma_m=0.015, range_max_m=60.0)
    return Rig(sensors={SPINNING: sensor}, odometry=ON_LEVEL_FLOOR)


def checked_rig(rig: Rig) -> Rig:
    """The rig, if its sensors are among those that can be simulated.

    Raises:
        ValueError: another sensor, or bearing noise or a sweep of a 3D sensor.
    """
    for name, sensor in rig.sensors.items():
        if name not in BEAMS:
            raise ValueError(f"rig: expected sensors among {', '.join(BEAMS)}, got {name!r}")
        if BEAMS[name].angles is None and (sensor.bearing_sigma_rad > 0.0 or sensor.sweep_s > 0.0):
            raise ValueError(f"rig: expected bearing noise and sweeps of 2D lasers only, got them of {name!r}")
    return rig
