"""Pose errors shared by the points of a scan, summed over scans into a plane's covariance, without keeping points.

With h = (1, x, y) a plane's perturbation is -A^-1 sum_s K_s xi_s, K_s = sum_{i in s} w_i h_i n^T dp_i/dxi. As h is
linear in (1, p - r) for any fixed point r, the sums are kept for that: m_s, shape (4, 6), and
D = sum_st m_s E[xi_s xi_t^T] m_t^T, shape (4, 4). The plane's frame may turn and shift afterwards; only the normal in
n^T dp/dxi is that of the time.

Errors of successive scans may be correlated, rho^|s - t|: a running sum u carries what the scans before contribute.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner, njit
from spplanes._rows import cross, minus
from spplanes._threads import in_parts
from spplanes.fitting._moment_patches import variance_from


def roots(pose_covariances: FloatArray) -> FloatArray:
    """Symmetric square roots of covariances, shape (S, 6, 6)."""
    values, vectors = np.linalg.eigh(pose_covariances)
    return (vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]) @ vectors.transpose(0, 2, 1)


@njit(cache=True)
def accumulate(grid, regions, errors, total, running):
    """Add the scans of a grid (points, covariances, labels) to the sums D (R, 4, 4) and u (R, 6, 4) of their regions.
    ``regions`` are planes (normal, d), (R, 4), and the points r, (R, 3); ``errors`` the square roots of the scans' pose
    covariances, (S, 6, 6), the points about which they turn, (S, 3), and rho, 0 for independent ones."""
    (_, _, labels), (pose_roots, origins, decay) = grid, errors
    n_regions = total.shape[0]
    moments, gain, row = np.zeros((n_regions, 4, 6)), np.empty((4, 6)), np.empty(6)
    seen = np.zeros(n_regions, dtype=np.bool_)
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r >= 0:
                seen[r] = True
                _add(moments[r], grid, i, j, regions, r, origins, row)
        for r in range(n_regions):
            if seen[r]:
                for a in range(4):  # the moments of the region times the root of the scan
                    for k in range(6):
                        gain[a, k] = 0.0
                    for m in range(6):
                        for k in range(6):
                            gain[a, k] += moments[r, a, m] * pose_roots[i, m, k]
                        moments[r, a, m] = 0.0
                for a in range(4):
                    for b in range(4):
                        for k in range(6):
                            both = gain[b, k] + running[r, k, b]
                            total[r, a, b] += gain[a, k] * both + running[r, k, a] * gain[b, k]
                for k in range(6):
                    for a in range(4):
                        running[r, k, a] += gain[a, k]
            for k in range(6):
                for a in range(4):
                    running[r, k, a] *= decay
            seen[r] = False


@inlined
def _add(moments, grid, i, j, regions, r, origins, row):
    """Add w (1, p - r) (n^T dp/dxi) of point (i, j) to m (4, 6) of region r; `row` (6,) is scratch."""
    (points, covariance, _), (planes, anchors) = grid, regions
    w = 1.0 / variance_from(covariance, i, j, planes, r)
    lever(planes[r], minus(points[i, j], origins[i]), row)
    for k in range(4):
        h = w if k == 0 else w * (points[i, j, k - 1] - anchors[r, k - 1])
        for m in range(6):
            moments[k, m] += h * row[m]


@inner(cache=True)
def lever(v, q, out) -> None:
    """v^T dp/dxi, shape (6,): v itself, then the part of v along the velocity of q under each rotation."""
    out[0], out[1], out[2] = v[0], v[1], v[2]
    out[5], out[4], out[3] = cross(q, v)


def merge_sums(
    anchor_a: FloatArray, anchor_b: FloatArray, total_b: FloatArray, running_b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The sums of region b, (4, 4) and (6, 4), about the anchor of region a; what the two share in scans that both have
    points in is not in their sums, and left out."""
    shift = np.eye(4)
    shift[1:, 0] = anchor_b - anchor_a
    return shift @ total_b @ shift.T, running_b @ shift.T


def covariance_of(frame: FloatArray, spread: FloatArray, anchor: FloatArray, total: FloatArray) -> FloatArray:
    """What the pose errors add to the covariance of (z, theta, psi) of a plane, shape (3, 3), by D about the anchor r;
    ``spread`` is the diagonal of the plane's information: W, sum w x^2, sum w y^2."""
    to_plane = np.zeros((3, 4))
    to_plane[0, 0] = 1.0
    to_plane[1:, 1:] = frame[:3, :2].T
    to_plane[1:, 0] = frame[:3, :2].T @ (anchor - frame[:3, 3])
    gain = (np.array([1.0, -1.0, 1.0]) / spread)[:, None] * to_plane
    covariance = gain @ total @ gain.T
    return 0.5 * (covariance + covariance.T)


def shared_by_scan(points, pose_covariances, origins):
    """Covariance that the pose error of its scan gives every point, shape (S, B, 9); the points share that error."""
    result = np.empty((*points.shape[:2], 9))
    share_poses = partial(_share_poses, result, points, pose_covariances, origins)
    in_parts(share_poses, len(points), result[..., 0].size)
    return result


@njit(cache=True)
def _share_poses(result, points, pose_covariances, origins, first, last):
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
