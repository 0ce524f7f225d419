"""Numba kernels of the shared pose error: how the points of a scan, and with them the plane, follow its pose."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner, njit
from spplanes.fitting._sums import FLOOR


@inner(cache=True)
def lever(v, q, out) -> None:
    """v^T dp/dxi, shape (6,): v itself, then the part of v along the velocity of q under each rotation."""
    out[0], out[1], out[2] = v[0], v[1], v[2]
    out[3] = q[0] * v[1] - q[1] * v[0]
    out[4] = q[2] * v[0] - q[0] * v[2]
    out[5] = q[1] * v[2] - q[2] * v[1]


@inlined
def add_cross(base, a, b, sign, out) -> None:
    """base + sign a x b, shape (3,); out may be none of them."""
    out[0] = base[0] + sign * (a[1] * b[2] - a[2] * b[1])
    out[1] = base[1] + sign * (a[2] * b[0] - a[0] * b[2])
    out[2] = base[2] + sign * (a[0] * b[1] - a[1] * b[0])


@njit(cache=True)
def scan_sums(points, covs, step, scan, origins, frame, xi, info, cross, pose, plane_side, pose_side) -> float:
    """Sums of one Gauss-Newton step per scan: sum w f f^T, w f g^T, w g g^T, w r f, w r g; returns sum w r^2. r is the
    distance that the pose error leaves, f = (1, x, y) and g are those of the foot point that it implies."""
    axes, q, g, f = np.empty((3, 3)), np.empty(3), np.empty(6), np.ones(3)
    turn, seen, spread, drawn = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for j in range(3):
        for k in range(3):
            axes[j, k] = frame[k, j]
    normal, cost = axes[2], 0.0
    for i in range(points.shape[0]):
        s, c = scan[i], covs[i * step]
        turn[0], turn[1], turn[2] = xi[s, 5], xi[s, 4], xi[s, 3]
        # The point and its noise as they are once its scan's pose is corrected, p' = p - t - turn x q: with thousands
        # of points, weights half a percent off would pull harder than the few pose errors hold.
        add_cross(normal, turn, normal, 1.0, seen)
        for j in range(3):
            q[j] = points[i, j] - origins[s, j]
            spread[j] = c[j, 0] * seen[0] + c[j, 1] * seen[1] + c[j, 2] * seen[2]
        add_cross(spread, turn, spread, -1.0, drawn)
        add_cross(points[i], turn, q, -1.0, seen)
        x = y = r = variance = ux = uy = 0.0
        for j in range(3):
            p = seen[j] - xi[s, j] - frame[j, 3]
            x += axes[0, j] * p
            y += axes[1, j] * p
            r += axes[2, j] * p
            ux += axes[0, j] * drawn[j]
            uy += axes[1, j] * drawn[j]
            variance += normal[j] * drawn[j]
        least = FLOOR * (c[0, 0] + c[1, 1] + c[2, 2])
        if variance < least:
            variance, ux, uy = least, 0.0, 0.0
            spread[:] = 0.0
        w = 1.0 / variance
        for k in range(3):
            q[k] -= spread[k] * r * w
        lever(normal, q, g)
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


def levers(directions: FloatArray, arms: FloatArray) -> FloatArray:
    """`lever` of directions and of places, (..., 3) both, relative to what they turn about, shape (..., 6)."""
    turned = np.cross(arms, directions)[..., ::-1]
    return np.concatenate((np.broadcast_to(directions, turned.shape), turned), axis=-1)
