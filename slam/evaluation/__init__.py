"""How good is it: trajectories, relations and planes against what is known to be true."""

from slam.evaluation.folders import Evaluation, compare_with_truth, trajectory_metrics
from slam.evaluation.planes import FacingPair, PlaneMatch, facing_pairs, match_planes, metres_of_wall, plane_metrics
from slam.evaluation.sharpness import Sharpness, compare_sharpness
from slam.evaluation.trajectories import (
    Metric,
    PoseErrors,
    absolute_error,
    align,
    align_poses,
    alignment_of,
    common_poses,
    nearest_stamps,
    relation_errors,
    relation_metrics,
    relative_error,
    truth_T_estimate,
)

__all__ = [
    "Evaluation",
    "FacingPair",
    "Metric",
    "PlaneMatch",
    "PoseErrors",
    "Sharpness",
    "absolute_error",
    "align",
    "align_poses",
    "alignment_of",
    "common_poses",
    "compare_sharpness",
    "compare_with_truth",
    "facing_pairs",
    "match_planes",
    "metres_of_wall",
    "nearest_stamps",
    "plane_metrics",
    "relation_errors",
    "relation_metrics",
    "relative_error",
    "trajectory_metrics",
    "truth_T_estimate",
]
