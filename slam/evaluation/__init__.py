"""How good is it: trajectories, relations and planes against what is known to be true."""

from slam.evaluation.folders import compare_with_truth
from slam.evaluation.planes import FacingPair, PlaneMatch, facing_pairs, match_planes, metres_of_wall, plane_metrics
from slam.evaluation.sharpness import compare_sharpness
from slam.evaluation.trajectories import (
    Metric,
    PoseErrors,
    absolute_error,
    align,
    nearest_stamps,
    relation_errors,
    relation_metrics,
    relative_error,
    truth_T_estimate,
)

__all__ = [
    "FacingPair",
    "Metric",
    "PlaneMatch",
    "PoseErrors",
    "absolute_error",
    "align",
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
    "truth_T_estimate",
]
