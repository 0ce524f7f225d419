"""Random drives with truth: a building, a sensor, an odometry and a disturbance, each drawn from a seed."""

from slam.simulation.drives.disturbances import DISTURBANCES
from slam.simulation.drives.drive import Drive, Recipe, make_drive
from slam.simulation.drives.sensing import SENSORS
from slam.simulation.drives.wheels import ODOMETRIES
from slam.simulation.drives.worlds import WORLDS

__all__ = ["DISTURBANCES", "ODOMETRIES", "SENSORS", "WORLDS", "Drive", "Recipe", "make_drive"]
