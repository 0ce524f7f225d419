"""What the error of a scan's pose gives each of its points: J S J^T, for where points must stand for themselves."""

from __future__ import annotations

import numpy as np

from spplanes._jit import njit
from spplanes._threads import in_parts


def shared_by_scan(points, pose_covariances, origins):
    """Covariance that the pose error of its scan gives every point, shape (S, B, 9); the points share that error."""
    result = np.empty((*points.shape[:2], 9))
    in_parts(
        lambda first, last: _share_poses(points, pose_covariances, origins, first, last, result),
        len(points),
        result[..., 0].size,
    )
    return result


@njit(cache=True)
def _share_poses(points, pose_covariances, origins, first, last, result):
    """J S J^T of the points in the rows from first to last, J = d p / d (x, y, z, phi, theta, psi), written out."""
    half = np.empty((3, 6))
    for i in range(first, last):
        pose = pose_covariances[i]
        for j in range(points.shape[1]):
            x, y, z = points[i, j, 0] - origins[i, 0], points[i, j, 1] - origins[i, 1], points[i, j, 2] - origins[i, 2]
            for k in range(6):
                half[0, k] = pose[0, k] - y * pose[3, k] + z * pose[4, k]
                half[1, k] = pose[1, k] + x * pose[3, k] - z * pose[5, k]
                half[2, k] = pose[2, k] - x * pose[4, k] + y * pose[5, k]
            for a in range(3):
                result[i, j, 3 * a] = half[a, 0] - y * half[a, 3] + z * half[a, 4]
                result[i, j, 3 * a + 1] = half[a, 1] + x * half[a, 3] - z * half[a, 5]
                result[i, j, 3 * a + 2] = half[a, 2] - x * half[a, 4] + y * half[a, 5]
