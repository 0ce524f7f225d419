"""Numba kernels of the shared pose error: how the points of a scan, and with them the plane, follow its pose."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes._fit_sums import FLOOR


@njit(cache=True)
def lever(v, q, out) -> None:
    """v^T dp/dxi, shape (6,): v itself, then the part of v along the velocity of q under each rotation."""
    out[0], out[1], out[2] = v[0], v[1], v[2]
    out[3] = q[0] * v[1] - q[1] * v[0]
    out[4] = q[2] * v[0] - q[0] * v[2]
    out[5] = q[1] * v[2] - q[2] * v[1]


@njit(cache=True)
def scan_sums(points, covs, step, scan, origins, frame, xi, info, cross, pose, plane_side, pose_side) -> float:
    """Sums of one Gauss-Newton step per scan: sum w f f^T, w f g^T, w g g^T, w r f, w r g; returns sum w r^2.

    r = z - g.xi is the distance that the pose error leaves, f = (1, x, y) at the foot point it implies.
    """
    axes, q, g, f = np.empty((3, 3)), np.empty(3), np.empty(6), np.ones(3)
    for j in range(3):
        for k in range(3):
            axes[j, k] = frame[k, j]
    normal, cost = axes[2], 0.0
    for i in range(points.shape[0]):
        s, c = scan[i], covs[i * step]
        for k in range(3):
            q[k] = points[i, k] - origins[s, k]
        lever(normal, q, g)
        x = y = r = variance = ux = uy = 0.0
        for j in range(3):
            u = c[j, 0] * normal[0] + c[j, 1] * normal[1] + c[j, 2] * normal[2]
            x += axes[0, j] * (points[i, j] - frame[j, 3])
            y += axes[1, j] * (points[i, j] - frame[j, 3])
            r += axes[2, j] * (points[i, j] - frame[j, 3])
            ux += axes[0, j] * u
            uy += axes[1, j] * u
            variance += normal[j] * u
        for k in range(6):
            r -= g[k] * xi[s, k]
        least = FLOOR * (c[0, 0] + c[1, 1] + c[2, 2])
        if variance < least:
            variance, ux, uy = least, 0.0, 0.0
        w = 1.0 / variance
        f[1], f[2] = x - ux * r * w, y - uy * r * w
        cost += w * r * r
        for j in range(3):
            plane_side[s, j] += w * r * f[j]
            for k in range(3):
                info[s, j, k] += w * f[j] * f[k]
            for k in range(6):
                cross[s, j, k] += w * f[j] * g[k]
        for j in range(6):
            pose_side[s, j] += w * r * g[j]
            for k in range(6):
                pose[s, j, k] += w * g[j] * g[k]
    return cost


@njit(cache=True)
def sp_pose_derivative(points, covs, step, scan, origins, frame, spread, out) -> None:
    """Derivative of the paper's (z, theta, psi) by each scan's xi, shape (S, 3, 6), through all its points.

    ``spread``: W, lambda_x - lambda_z and lambda_y - lambda_z, shape (3,).
    """
    q, d, v, g = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(6)
    for i in range(points.shape[0]):
        s, c = scan[i], covs[i * step]
        trace = c[0, 0] + c[1, 1] + c[2, 2]
        x = y = z = 0.0
        for k in range(3):
            q[k] = points[i, k] - origins[s, k]
            d[k] = points[i, k] - frame[k, 3]
            x += frame[k, 0] * d[k]
            y += frame[k, 1] * d[k]
            z += frame[k, 2] * d[k]
        for k in range(3):
            v[0, k] = frame[k, 2] / spread[0]
            v[1, k] = -(x * frame[k, 2] + z * frame[k, 0]) / spread[1]
            v[2, k] = (y * frame[k, 2] + z * frame[k, 1]) / spread[2]
        for j in range(3):
            lever(v[j], q, g)
            for k in range(6):
                out[s, j, k] += g[k] / (trace * trace)


@njit(cache=True)
def inflate(points, covs, step, scan, origins, roots, out) -> None:
    """Write each point's covariance with its scan's pose error folded in, (N, 3, 3): to judge single points by."""
    axes, q, g, half = np.eye(3), np.empty(3), np.empty(6), np.zeros((3, 6))
    for i in range(points.shape[0]):
        s = scan[i]
        for k in range(3):
            q[k] = points[i, k] - origins[s, k]
        for j in range(3):
            lever(axes[j], q, g)
            for k in range(6):
                half[j, k] = 0.0
                for m in range(6):
                    half[j, k] += g[m] * roots[s, m, k]
        for j in range(3):
            for k in range(3):
                out[i, j, k] = covs[i * step, j, k]
                for m in range(6):
                    out[i, j, k] += half[j, m] * half[k, m]
