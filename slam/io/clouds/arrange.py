"""The range image in which a sensor of the rig sees."""

from __future__ import annotations

from slam.sensors.rig import Sensor
from spplanes.clouds.arrange import Grid


def grid_of(sensor: Sensor) -> Grid | None:
    """The range image that a rig states for a sensor."""
    return None if sensor.rows is None or sensor.columns is None else Grid(sensor.rows, sensor.columns)
