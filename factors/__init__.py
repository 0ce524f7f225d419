"""GTSAM factors from SP planes, laser lines and odometry."""

from factors.landmarks import (
    joint_covariance,
    landmark_to_plane,
    plane_landmark,
    world_plane,
    world_plane_from_joint,
)
from factors.line import line_factor
from factors.odometry import odometry_factor, odometry_factor_2d, planar_motion_factor
from factors.plane import plane_factor, plane_factors, plane_prior

__all__ = [
    "joint_covariance",
    "landmark_to_plane",
    "line_factor",
    "odometry_factor",
    "odometry_factor_2d",
    "planar_motion_factor",
    "plane_factor",
    "plane_factors",
    "plane_landmark",
    "plane_prior",
    "world_plane",
    "world_plane_from_joint",
]
