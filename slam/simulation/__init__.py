"""Worlds, robots and sensors with ground truth."""

from slam.errors import WORLDS
from slam.simulation.mission import Mission, ScanArrays, simulate_mission
from slam.simulation.record import Truth
from slam.simulation.robots import HORIZONTAL, SPINNING, VERTICAL, Path, paper_rig, spinning_rig
from slam.simulation.world import World, WorldBuilder

__all__ = [
    "HORIZONTAL",
    "SPINNING",
    "VERTICAL",
    "WORLDS",
    "Mission",
    "Path",
    "ScanArrays",
    "Truth",
    "World",
    "WorldBuilder",
    "paper_rig",
    "simulate_mission",
    "spinning_rig",
]
