"""Laser odometry: every scan of a level laser is matched to a local map, with wheel odometry or without."""

from slam.frontend.laser_odometry.track import LaserTrack, motion_between
from slam.frontend.laser_odometry.tracker import is_level, laser_track

__all__ = ["LaserTrack", "is_level", "laser_track", "motion_between"]
