"""Relations files (Kuemmerle et al. 2009), hand-verified relative poses, and trajectories against them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam.evaluation.metrics import Metric
from slam.evaluation.trajectories import PoseErrors, nearest_stamps, pose_errors
from slam.io._numbers import read_rows
from slam.io.trajectories import Trajectory
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Relations:
    """Relative poses a_T_b between two times each."""

    stamps_ns: np.ndarray
    """Times of a and b, shape (R, 2), int64."""
    a_T_b: FloatArray
    """Pose of the robot at b in its frame at a, shape (R, 4, 4)."""

    def __len__(self) -> int:
        return len(self.stamps_ns)


def read_relations(path: Path | str) -> Relations:
    """Read lines `t1 t2 dx dy dz roll pitch yaw`, plain or gzip; R = Rz(yaw) Ry(pitch) Rx(roll).

    Raises:
        LogError: one sentence with file and line: not eight finite numbers, or no relations at all.

    References:
        Kuemmerle et al., "On Measuring the Accuracy of SLAM Algorithms", Autonomous Robots 27(4), 2009.
    """
    stamps, values, _ = read_rows(Path(path), columns=8, stamp_columns=2)
    a_T_b = np.tile(np.eye(4), (len(values), 1, 1))
    a_T_b[:, :3, :3] = Rotation.from_euler("xyz", values[:, 3:]).as_matrix()
    a_T_b[:, :3, 3] = values[:, :3]
    return Relations(stamps, a_T_b)


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
