"""Ray casting into rectangles and round bars: exact ranges and what was hit, the only kernels of the simulator."""

from __future__ import annotations

import numpy as np
from numba import njit

#: Hits closer than this do not count: the ray starts on the surface.
NEAREST_M = 1e-6
#: Index of a ray that hits nothing.
NOTHING = -1


@njit(cache=True)
def _crosses(corner, edge_u, edge_v, origin, normal):
    """Whether a rectangle has corners on both sides of the plane through `origin`, or on it."""
    first = 0.0
    span_u = 0.0
    span_v = 0.0
    for k in range(3):
        first += normal[k] * (corner[k] - origin[k])
        span_u += normal[k] * edge_u[k]
        span_v += normal[k] * edge_v[k]
    low = first + min(span_u, 0.0) + min(span_v, 0.0)
    high = first + max(span_u, 0.0) + max(span_v, 0.0)
    return low <= 0.0 <= high


@njit(cache=True)
def _nearer_rectangle(corner, edge_u, edge_v, origin, rays, index, ranges, hits):
    """Enter the rectangle corner + a u + b v, 0 <= a, b <= 1, where a ray of the scan hits it first."""
    nx = edge_u[1] * edge_v[2] - edge_u[2] * edge_v[1]
    ny = edge_u[2] * edge_v[0] - edge_u[0] * edge_v[2]
    nz = edge_u[0] * edge_v[1] - edge_u[1] * edge_v[0]
    dx, dy, dz = corner[0] - origin[0], corner[1] - origin[1], corner[2] - origin[2]
    offset = nx * dx + ny * dy + nz * dz
    length_u = edge_u[0] ** 2 + edge_u[1] ** 2 + edge_u[2] ** 2
    length_v = edge_v[0] ** 2 + edge_v[1] ** 2 + edge_v[2] ** 2
    for b in range(len(rays)):
        slope = nx * rays[b, 0] + ny * rays[b, 1] + nz * rays[b, 2]
        if slope * offset <= 0.0:
            continue
        t = offset / slope
        if not NEAREST_M < t < ranges[b]:
            continue
        px, py, pz = t * rays[b, 0] - dx, t * rays[b, 1] - dy, t * rays[b, 2] - dz
        along_u = px * edge_u[0] + py * edge_u[1] + pz * edge_u[2]
        along_v = px * edge_v[0] + py * edge_v[1] + pz * edge_v[2]
        if 0.0 <= along_u <= length_u and 0.0 <= along_v <= length_v:
            ranges[b], hits[b] = t, index


@njit(cache=True)
def _hit_bar(foot, axis, radius, origin, ray):
    """Distance along the unit `ray` to the mantle of the bar foot + a axis, 0 <= a <= 1; infinity for a miss."""
    length2 = axis[0] ** 2 + axis[1] ** 2 + axis[2] ** 2
    dx, dy, dz = origin[0] - foot[0], origin[1] - foot[1], origin[2] - foot[2]
    ray_a = (ray[0] * axis[0] + ray[1] * axis[1] + ray[2] * axis[2]) / length2
    off_a = (dx * axis[0] + dy * axis[1] + dz * axis[2]) / length2
    rx, ry, rz = ray[0] - ray_a * axis[0], ray[1] - ray_a * axis[1], ray[2] - ray_a * axis[2]
    ox, oy, oz = dx - off_a * axis[0], dy - off_a * axis[1], dz - off_a * axis[2]
    a = rx * rx + ry * ry + rz * rz
    b = rx * ox + ry * oy + rz * oz
    c = ox * ox + oy * oy + oz * oz - radius * radius
    root = b * b - a * c
    if a == 0.0 or root < 0.0:
        return np.inf
    root = np.sqrt(root)
    for t in ((-b - root) / a, (-b + root) / a):
        if t > NEAREST_M and 0.0 <= off_a + t * ray_a <= 1.0:
            return t
    return np.inf


@njit(cache=True)
def cast_scans(origins, rays, scan_normals, corners, edges_u, edges_v, feet, axes, radii):
    """Nearest hit of every ray of every scan.

    Args:
        origins: where each scan starts, shape (S, 3), m.
        rays: unit directions in the world, shape (S, B, 3).
        scan_normals: normal of the plane that all rays of a scan lie in, shape (S, 3); zero for scans in 3D. Objects
            that do not cross that plane are left out at once.
        corners: a corner of each rectangle, shape (R, 3), m.
        edges_u: first edge of each rectangle, shape (R, 3), m.
        edges_v: second edge, orthogonal to the first, shape (R, 3), m.
        feet: one end of the axis of each bar, shape (C, 3), m.
        axes: from that end to the other, shape (C, 3), m.
        radii: radius of each bar, shape (C,), m.

    Returns:
        ranges (S, B), infinity where nothing was hit; hits (S, B) int32: index of the rectangle, R + index of the
        bar, or `NOTHING`.
    """
    n_scans, n_beams = rays.shape[0], rays.shape[1]
    n_rectangles, n_bars = corners.shape[0], feet.shape[0]
    ranges = np.full((n_scans, n_beams), np.inf)
    hits = np.full((n_scans, n_beams), NOTHING, dtype=np.int32)
    for s in range(n_scans):
        for r in range(n_rectangles):
            if not _crosses(corners[r], edges_u[r], edges_v[r], origins[s], scan_normals[s]):
                continue
            _nearer_rectangle(corners[r], edges_u[r], edges_v[r], origins[s], rays[s], r, ranges[s], hits[s])
        for c in range(n_bars):
            for b in range(n_beams):
                t = _hit_bar(feet[c], axes[c], radii[c], origins[s], rays[s, b])
                if t < ranges[s, b]:
                    ranges[s, b], hits[s, b] = t, n_rectangles + c
    return ranges, hits
