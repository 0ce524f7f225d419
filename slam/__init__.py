"""Plane-based SLAM: from sensor logs to a map of planes with covariances."""
