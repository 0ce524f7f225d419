"""Convex hulls of small groups of points, and convex polygons drawn on rasters."""

from __future__ import annotations

import numpy as np

from spplanes._jit import njit

#: Directions in which the farthest point of a group is a corner of its hull.
CORNERS = 16


@njit(cache=True)
def hulls_of_groups(points, order, bounds, region, projections, directions, corners):
    """Corners of the hulls of groups of points, each wider by half the distance of its points, in place.

    Args:
        points: shape (N, 3), m.
        order, bounds: points of group g are order[bounds[g]:bounds[g + 1]].
        region: of every group, shape (G,).
        projections: of every region, points to raster coordinates in cells, shape (R, 2, 4).
        directions: unit vectors in the order of their angles, shape (CORNERS, 2).
        corners: of every group, shape (G, CORNERS, 2).
    """
    support = np.empty(CORNERS)
    for g in range(region.shape[0]):
        p, n = projections[region[g]], bounds[g + 1] - bounds[g]
        support[:] = -np.inf
        mu = mv = 0.0
        for k in range(bounds[g], bounds[g + 1]):
            i = order[k]
            u = p[0, 0] * points[i, 0] + p[0, 1] * points[i, 1] + p[0, 2] * points[i, 2] + p[0, 3]
            v = p[1, 0] * points[i, 0] + p[1, 1] * points[i, 1] + p[1, 2] * points[i, 2] + p[1, 3]
            mu += u / n
            mv += v / n
            for d in range(CORNERS):
                reach = u * directions[d, 0] + v * directions[d, 1]
                if reach > support[d]:
                    support[d], corners[g, d, 0], corners[g, d, 1] = reach, u, v
        area = 0.0
        for d in range(CORNERS):
            e = (d + 1) % CORNERS
            area += 0.5 * (corners[g, d, 0] * corners[g, e, 1] - corners[g, e, 0] * corners[g, d, 1])
        wider = max(np.sqrt(max(area, 0.0) / n), 0.5)
        for d in range(CORNERS):
            du, dv = corners[g, d, 0] - mu, corners[g, d, 1] - mv
            length = np.sqrt(du * du + dv * dv)
            if length > 0.0:
                corners[g, d, 0] += wider * du / length
                corners[g, d, 1] += wider * dv / length


@njit(cache=True)
def fill_convex(filled, first, corner, shape, scale, region, corners):
    """Fill the cells of every region's raster whose centres lie in one of its convex polygons, in place."""
    for g in range(region.shape[0]):
        r = region[g]
        low, high = np.inf, -np.inf
        for d in range(CORNERS):
            u = corners[g, d, 0] * scale[r] - corner[r, 0] - 0.5
            low, high = min(low, u), max(high, u)
        for i in range(max(int(np.ceil(low)), 0), min(int(np.floor(high)), shape[r, 0] - 1) + 1):
            least, most = np.inf, -np.inf
            for d in range(CORNERS):
                e = (d + 1) % CORNERS
                u0 = corners[g, d, 0] * scale[r] - corner[r, 0] - 0.5
                u1 = corners[g, e, 0] * scale[r] - corner[r, 0] - 0.5
                v0 = corners[g, d, 1] * scale[r] - corner[r, 1] - 0.5
                v1 = corners[g, e, 1] * scale[r] - corner[r, 1] - 0.5
                if min(u0, u1) <= i <= max(u0, u1):
                    v = v0 + (v1 - v0) * (i - u0) / (u1 - u0) if u1 != u0 else v0
                    least, most = min(least, v), max(most, v)
            start = first[r] + i * shape[r, 1]
            for j in range(max(int(np.ceil(least)), 0), min(int(np.floor(most)), shape[r, 1] - 1) + 1):
                filled[start + j] = True
