"""Worlds, robots and sensors with ground truth."""

from slam.simulation.mission import HORIZONTAL, VERTICAL, Mission, ScanArrays, Truth, paper_rig, simulate_mission
from slam.simulation.path import Path
from slam.simulation.world import World, WorldBuilder

__all__ = [
    "HORIZONTAL",
    "VERTICAL",
    "Mission",
    "Path",
    "ScanArrays",
    "Truth",
    "World",
    "WorldBuilder",
    "paper_rig",
    "simulate_mission",
]
