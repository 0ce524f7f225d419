"""Trajectories against hand-verified relative poses."""

from __future__ import annotations

import numpy as np

from slam.evaluation.metrics import Metric
from slam.evaluation.trajectories import PoseErrors, nearest_stamps, pose_errors
from slam.io.relations import Relations
from slam.io.trajectories import Trajectory

#: Names of the rows that say how many relations were scored, and how many there are.
FOUND, STATED = "relations found", "relations in the file"
#: A relation counts when the trajectory has poses *less* than 1 ms from both of its times, ns.
TOLERANCE_NS = 1_000_000 - 1


def relation_errors(estimate: Trajectory, relations: Relations, *, tolerance_ns: int = TOLERANCE_NS) -> PoseErrors:
    """Error of the estimate's relative poses for those relations whose two times it has.

    References:
        Kuemmerle et al., "On Measuring the Accuracy of SLAM Algorithms", Autonomous Robots 27(4), 2009.
    """
    first, last = (nearest_stamps(column, estimate.stamps_ns, tolerance_ns) for column in relations.stamps_ns.T)
    found = (first >= 0) & (last >= 0)
    moved = np.linalg.inv(estimate.poses[first[found]]) @ estimate.poses[last[found]]
    return pose_errors(np.linalg.inv(relations.a_T_b[found]) @ moved)


def relation_metrics(estimate: Trajectory, relations: Relations) -> list[Metric]:
    """How many relations were found, and the errors; the mean is the figure published for this benchmark.

    Raises:
        ValueError: none of the relations' times is in the trajectory.
    """
    errors = relation_errors(estimate, relations)
    if errors.translation_m.size == 0:
        raise ValueError("relations: expected times of the trajectory, got none that agree to 1 ms")
    counts = [Metric(FOUND, errors.translation_m.size, ""), Metric(STATED, len(relations), "")]
    return counts + errors.metrics("relations")
