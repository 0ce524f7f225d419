"""Tracking: the next pose before anything is looked at, by odometry, constant velocity and wheel calibration."""
