"""GTSAM factors from SP planes, laser lines and odometry."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import factors.archive  # noqa: F401  tells `copy` and `pickle` about plane factors, whoever made them

if TYPE_CHECKING:
    from factors._conventions import hesse as landmark_hesse
    from factors.archive import copy_graph
    from factors.association.associate import Association, Identity, associate
    from factors.association.estimate import observation_factor
    from factors.association.gates import AssociationGates
    from factors.association.landmark_extents import LandmarkExtents
    from factors.association.observations import LineObservation, PlaneObservation
    from factors.association.prediction import Prediction
    from factors.isam import isam2_parameters, isam_covariance, settle
    from factors.landmarks import (
        change_anchor,
        facing,
        joint_covariance,
        landmark_anchors,
        landmark_to_plane,
        plane_landmark,
        seen_plane,
        world_plane,
        world_plane_from_joint,
    )
    from factors.line import line_factor, line_factor_2d
    from factors.maps import anchored_plane_jacobian, map_prior
    from factors.odometry import odometry_factor, odometry_factor_2d, planar_motion_factor
    from factors.plane import get_ready, plane_factor, plane_factors, plane_prior
    from factors.pose import gravity_factor, pose_prior, relative_pose_factor
    from factors.structure import (
        direction_prior,
        distance_factor,
        parallel_factor,
        perpendicular_factor,
        upright_prior,
    )

__all__ = [
    "Association",
    "AssociationGates",
    "Identity",
    "LandmarkExtents",
    "LineObservation",
    "PlaneObservation",
    "Prediction",
    "anchored_plane_jacobian",
    "associate",
    "change_anchor",
    "copy_graph",
    "direction_prior",
    "distance_factor",
    "facing",
    "get_ready",
    "gravity_factor",
    "isam2_parameters",
    "isam_covariance",
    "joint_covariance",
    "landmark_anchors",
    "landmark_hesse",
    "landmark_to_plane",
    "line_factor",
    "line_factor_2d",
    "map_prior",
    "observation_factor",
    "odometry_factor",
    "odometry_factor_2d",
    "parallel_factor",
    "perpendicular_factor",
    "planar_motion_factor",
    "plane_factor",
    "plane_factors",
    "plane_landmark",
    "plane_prior",
    "pose_prior",
    "relative_pose_factor",
    "seen_plane",
    "settle",
    "upright_prior",
    "world_plane",
    "world_plane_from_joint",
]

_OF_MODULES = {
    "archive": ("copy_graph",),
    "association.associate": ("Association", "Identity", "associate"),
    "association.estimate": ("observation_factor",),
    "association.gates": ("AssociationGates",),
    "association.landmark_extents": ("LandmarkExtents",),
    "association.observations": ("LineObservation", "PlaneObservation"),
    "association.prediction": ("Prediction",),
    "isam": ("isam2_parameters", "isam_covariance", "settle"),
    "landmarks": (
        "change_anchor",
        "facing",
        "joint_covariance",
        "landmark_anchors",
        "landmark_to_plane",
        "plane_landmark",
        "seen_plane",
        "world_plane",
        "world_plane_from_joint",
    ),
    "line": ("line_factor", "line_factor_2d"),
    "maps": ("anchored_plane_jacobian", "map_prior"),
    "odometry": ("odometry_factor", "odometry_factor_2d", "planar_motion_factor"),
    "plane": ("get_ready", "plane_factor", "plane_factors", "plane_prior"),
    "pose": ("gravity_factor", "pose_prior", "relative_pose_factor"),
    "structure": ("direction_prior", "distance_factor", "parallel_factor", "perpendicular_factor", "upright_prior"),
}
_HOMES = {name: (module, name) for module, names in _OF_MODULES.items() for name in names}
_HOMES["landmark_hesse"] = ("_conventions", "hesse")


def __getattr__(name: str) -> Any:
    # imported when asked for: most need compiled kernels, and numba takes longer to import than GTSAM
    if name not in _HOMES:
        raise AttributeError(f"module 'factors' has no attribute {name!r}")
    from importlib import import_module

    module, inside = _HOMES[name]
    globals()[name] = found = getattr(import_module(f"factors.{module}"), inside)
    return found


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
