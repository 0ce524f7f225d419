"""Joining: finished missions through one building become one map, with one covariance."""

from slam.joining.join import join
from slam.joining.joined_map import JoinedComponent, JoinedMap
from slam.joining.mission import FinishedMission, Mission
from slam.joining.overlap import Comparison
from slam.joining.solution import JoinError

__all__ = ["Comparison", "FinishedMission", "JoinError", "JoinedComponent", "JoinedMap", "Mission", "join"]
