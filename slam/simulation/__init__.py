"""Worlds, robots and sensors with ground truth."""

from slam.errors import WORLDS
from slam.simulation.mission import Mission, ScanArrays, simulate_mission
from slam.simulation.path import Path
from slam.simulation.rigs import HORIZONTAL, SPINNING, VERTICAL, paper_rig, spinning_rig
from slam.simulation.truth import Truth
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
