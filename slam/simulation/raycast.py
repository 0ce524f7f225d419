"""Ray casting into rectangles, round bars and planar polygons: exact ranges and what was hit."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, njit

#: Hits closer than this do not count: the ray starts on the surface.
NEAREST_M = 1e-6
#: Index of a ray that hits nothing.
NOTHING = -1


@inlined
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


@inlined
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


@inlined
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
    ranges, hits = np.empty((n_scans, n_beams)), np.empty((n_scans, n_beams), dtype=np.int32)
    for s in range(n_scans):
        for b in range(n_beams):
            ranges[s, b], hits[s, b] = np.inf, NOTHING
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


@inlined
def _inside(x, y, edges, first, last):
    """Whether a point of a polygon's plane is inside its rings: an odd number of edges to the right of it."""
    odd = False
    for k in range(first, last):
        x0, y0, x1, y1 = edges[k, 0], edges[k, 1], edges[k, 2], edges[k, 3]
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            odd = not odd
    return odd


@inlined
def _polygon_crosses(frame, edges, first, last, origin, normal):
    """Whether a polygon has corners on both sides of the plane through `origin`, or on it."""
    offset = 0.0
    slope_x = 0.0
    slope_y = 0.0
    for k in range(3):
        offset += normal[k] * (frame[k, 3] - origin[k])
        slope_x += normal[k] * frame[k, 0]
        slope_y += normal[k] * frame[k, 1]
    low, high = np.inf, -np.inf
    for k in range(first, last):
        height = offset + slope_x * edges[k, 0] + slope_y * edges[k, 1]
        low, high = min(low, height), max(high, height)
    return low <= 0.0 <= high


@njit(cache=True)
def cast_polygons(origins, rays, scan_normals, frames, edges, first_edges, first_hit, ranges, hits):
    """Enter the polygons that are nearer than what the rays hit so far into `ranges` and `hits`, both (S, B).

    Args:
        origins, rays, scan_normals: as for `cast_scans`.
        frames: of each polygon, shape (G, 4, 4): it lies in x and y, z is its normal.
        edges: of all rings of all polygons, rows (x0, y0, x1, y1) in their polygon's frame, shape (E, 4), m.
        first_edges: where the edges of each polygon begin, and where the last one's end, shape (G + 1,).
        first_hit: index that `hits` gets for the first polygon.
    """
    for s in range(rays.shape[0]):
        for g in range(frames.shape[0]):
            frame, first, last = frames[g], first_edges[g], first_edges[g + 1]
            if not _polygon_crosses(frame, edges, first, last, origins[s], scan_normals[s]):
                continue
            dx, dy, dz = frame[0, 3] - origins[s, 0], frame[1, 3] - origins[s, 1], frame[2, 3] - origins[s, 2]
            offset = frame[0, 2] * dx + frame[1, 2] * dy + frame[2, 2] * dz
            for b in range(rays.shape[1]):
                ray = rays[s, b]
                slope = frame[0, 2] * ray[0] + frame[1, 2] * ray[1] + frame[2, 2] * ray[2]
                if slope * offset <= 0.0:
                    continue
                t = offset / slope
                if not NEAREST_M < t < ranges[s, b]:
                    continue
                px, py, pz = t * ray[0] - dx, t * ray[1] - dy, t * ray[2] - dz
                x = px * frame[0, 0] + py * frame[1, 0] + pz * frame[2, 0]
                y = px * frame[0, 1] + py * frame[1, 1] + pz * frame[2, 1]
                if _inside(x, y, edges, first, last):
                    ranges[s, b], hits[s, b] = t, first_hit + g
