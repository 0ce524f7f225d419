"""Joining: finished missions through one building become one map, with one covariance."""
