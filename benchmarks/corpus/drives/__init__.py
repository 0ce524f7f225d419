"""Random drives with truth: a building, a sensor, an odometry and a disturbance, each drawn from a seed."""

from benchmarks.corpus.drives.disturbances import DISTURBANCES, Drive
from benchmarks.corpus.drives.drive import Recipe, make_drive
from benchmarks.corpus.drives.sensing import SENSORS
from benchmarks.corpus.drives.wheels import ODOMETRIES
from benchmarks.corpus.drives.worlds import WORLDS

__all__ = ["DISTURBANCES", "ODOMETRIES", "SENSORS", "WORLDS", "Drive", "Recipe", "make_drive"]
