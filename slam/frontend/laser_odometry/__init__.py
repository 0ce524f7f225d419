"""Laser odometry: every scan of a level laser is matched to a local map, with wheel odometry or without."""
