"""Unit quaternions (x, y, z, w) as files and messages write them: one check, one tolerance, poses out of them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from spplanes._check import FloatArray

#: A quaternion, a normal or a rotation that somebody wrote down may miss unit norm by this much: four digits.
NORM_TOLERANCE = 1e-3


def norms_of(quaternions: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Norms (N,) of quaternions (N, 4), and which of them (N,) are no unit: infinite and NaN are none either."""
    with np.errstate(over="ignore", invalid="ignore"):
        norms = np.linalg.norm(quaternions, axis=1)
    return norms, ~(np.abs(norms - 1.0) <= NORM_TOLERANCE)


def poses_of(numbers: FloatArray) -> FloatArray:
    """Rows x y z qx qy qz qw (N, 7) as transforms (N, 4, 4); the quaternions are normalised.

    Raises:
        ValueError: a position that is not finite, or a quaternion that is none; the sentence has the first one's norm.
    """
    norms, wrong = norms_of(numbers[:, 3:])
    for bad in np.flatnonzero(wrong)[:1]:
        raise ValueError(f"expected a unit quaternion, got one of norm {norms[bad]:.6g}")
    if not np.isfinite(numbers[:, :3]).all():
        raise ValueError("expected finite positions, got NaN or infinity")
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(numbers[:, 3:]).as_matrix()
    poses[:, :3, 3] = numbers[:, :3]
    return poses
