"""Relations files (Kuemmerle et al. 2009): hand-verified relative poses between pairs of times."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from slam.io._numbers import read_rows
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
    stamps, rows, _ = read_rows(Path(path), columns=8, stamp_columns=2)
    values = np.array(rows)
    a_T_b = np.tile(np.eye(4), (len(rows), 1, 1))
    a_T_b[:, :3, :3] = Rotation.from_euler("xyz", values[:, 3:]).as_matrix()
    a_T_b[:, :3, 3] = values[:, :3]
    return Relations(np.array(stamps, dtype=np.int64), a_T_b)
