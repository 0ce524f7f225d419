"""GTSAM factors from SP planes, laser lines and odometry."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import factors.archive  # noqa: F401  tells `copy` and `pickle` about plane factors, whoever made them

if TYPE_CHECKING:
    from factors._conventions import landmark_hesse as landmark_hesse
    from factors.archive import copy_graph as copy_graph
    from factors.association.associate import Association as Association
    from factors.association.associate import Identity as Identity
    from factors.association.associate import associate as associate
    from factors.association.decisions import AssociationGates as AssociationGates
    from factors.association.estimate import observation_factor as observation_factor
    from factors.association.landmark_extents import LandmarkExtents as LandmarkExtents
    from factors.association.observations import LineObservation as LineObservation
    from factors.association.observations import PlaneObservation as PlaneObservation
    from factors.association.prediction import Prediction as Prediction
    from factors.isam import isam2_parameters as isam2_parameters
    from factors.isam import isam_covariance as isam_covariance
    from factors.isam import settle as settle
    from factors.landmarks import change_anchor as change_anchor
    from factors.landmarks import facing as facing
    from factors.landmarks import joint_covariance as joint_covariance
    from factors.landmarks import landmark_anchors as landmark_anchors
    from factors.landmarks import landmark_to_plane as landmark_to_plane
    from factors.landmarks import plane_landmark as plane_landmark
    from factors.landmarks import seen_plane as seen_plane
    from factors.landmarks import world_plane as world_plane
    from factors.landmarks import world_plane_from_joint as world_plane_from_joint
    from factors.line import line_factor as line_factor
    from factors.line import line_factor_2d as line_factor_2d
    from factors.plane import anchored_plane_jacobian as anchored_plane_jacobian
    from factors.plane import get_ready as get_ready
    from factors.plane import map_prior as map_prior
    from factors.plane import plane_factor as plane_factor
    from factors.plane import plane_factors as plane_factors
    from factors.plane import plane_prior as plane_prior
    from factors.pose import constant_velocity_factor as constant_velocity_factor
    from factors.pose import gravity_factor as gravity_factor
    from factors.pose import odometry_factor as odometry_factor
    from factors.pose import odometry_factor_2d as odometry_factor_2d
    from factors.pose import planar_motion_factor as planar_motion_factor
    from factors.pose import pose_prior as pose_prior
    from factors.pose import relative_pose_factor as relative_pose_factor
    from factors.structure import direction_prior as direction_prior
    from factors.structure import distance_factor as distance_factor
    from factors.structure import parallel_factor as parallel_factor
    from factors.structure import perpendicular_factor as perpendicular_factor
    from factors.structure import upright_prior as upright_prior

#: Where each public name is.
_HOMES = {
    name: module
    for module, names in {
        "_conventions": "landmark_hesse",
        "archive": "copy_graph",
        "association.associate": "Association Identity associate",
        "association.decisions": "AssociationGates",
        "association.estimate": "observation_factor",
        "association.landmark_extents": "LandmarkExtents",
        "association.observations": "LineObservation PlaneObservation",
        "association.prediction": "Prediction",
        "isam": "isam2_parameters isam_covariance settle",
        "landmarks": "change_anchor facing joint_covariance landmark_anchors landmark_to_plane plane_landmark"
        " seen_plane world_plane world_plane_from_joint",
        "line": "line_factor line_factor_2d",
        "plane": "anchored_plane_jacobian get_ready map_prior plane_factor plane_factors plane_prior",
        "pose": "constant_velocity_factor gravity_factor odometry_factor odometry_factor_2d planar_motion_factor"
        " pose_prior relative_pose_factor",
        "structure": "direction_prior distance_factor parallel_factor perpendicular_factor upright_prior",
    }.items()
    for name in names.split()
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    # imported when asked for: most need compiled kernels, and numba takes longer to import than GTSAM
    if name not in _HOMES:
        raise AttributeError(f"module 'factors' has no attribute {name!r}")
    from importlib import import_module

    globals()[name] = found = getattr(import_module(f"factors.{_HOMES[name]}"), name)
    return found


def __dir__() -> list[str]:
    return sorted(set(globals()) | set(__all__))
