"""Square patches of planes: which points lie in one, what they share, and whether their means stay on the plane."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import njit

#: Patches are numbered by place where a grid over the plane has no more than so many for every point, else by sorting.
_ROOM, _LEAST_ROOM = 8, 1024
#: Patches further out than this are one.
_FARTHEST = 2.0**29


def patches_of(points, frame, side):
    """Row and column (N,) of the patch of every point, from 0 on, int64, and how many rows and columns there are.

    Args:
        points: shape (N, 3), m.
        frame: the plane's, shape (4, 4).
        side: of a patch, m.
    """
    row, column = _squares_of(points, frame.copy(), side)  # of a plane, it is protected: another type
    if len(points) == 0:
        return row, column, 0, 0
    row -= row.min()
    column -= column.min()
    return row, column, int(row.max()) + 1, int(column.max()) + 1


@njit(cache=True)
def _squares_of(points, frame, side):
    """Row and column (N,) of the square that every point lies in, the plane's origin at a corner of (0, 0)."""
    n = points.shape[0]
    row, column = np.empty(n, np.int64), np.empty(n, np.int64)
    for k in range(n):
        x, y, z = points[k, 0] - frame[0, 3], points[k, 1] - frame[1, 3], points[k, 2] - frame[2, 3]
        u = np.floor((x * frame[0, 0] + y * frame[1, 0] + z * frame[2, 0]) / side)
        v = np.floor((x * frame[0, 1] + y * frame[1, 1] + z * frame[2, 1]) / side)
        row[k] = int(min(max(u, -_FARTHEST), _FARTHEST))
        column[k] = int(min(max(v, -_FARTHEST), _FARTHEST))
    return row, column


def numbered(codes, span):
    """A number (N,) for every code from 0 to span - 1, the same for the same code, and how many numbers there are."""
    if span <= _ROOM * len(codes) + _LEAST_ROOM:
        return codes, span
    present, number = np.unique(codes, return_inverse=True)
    return number, len(present)


@njit(cache=True)
def with_shared(covariances, group, n_groups, direction, variance):
    """Covariances (N, 3, 3) that also carry an error along a direction which the points of a group share.

    n points that share an error say as much as n points with n times its variance each.

    Args:
        covariances: shape (N, 3, 3), m^2.
        group: of every point, shape (N,).
        n_groups: how many there are.
        direction: (1, 3), or (N, 3) of every point its own; its length scales the error.
        variance: of the error, m^2.
    """
    counts = np.zeros(n_groups, np.int64)
    for g in group:
        counts[g] += 1
    result = np.empty_like(covariances)
    own = direction.shape[0] > 1
    for k in range(group.shape[0]):
        shared = variance * counts[group[k]]
        d = direction[k if own else 0]
        for i in range(3):
            for j in range(3):
                result[k, i, j] = covariances[k, i, j] + shared * d[i] * d[j]
    return result


def strays(
    residuals: FloatArray,
    variances: FloatArray,
    drift: FloatArray,
    group: np.ndarray,
    n_groups: int,
    sigmas: float,
    least: float,
) -> np.ndarray:
    """Whether the weighted mean residual of each group is more than noise, drift and unevenness, shape (n_groups,).

    Args:
        residuals, variances: of every point along the plane's normal, shape (N,), m and m^2.
        drift: variance of what a slow error shifts every point by, shape (N,), or (0,) for none, m^2.
        group: of every point, shape (N,).
        n_groups: how many there are.
        sigmas, least: what a mean may be, in its standard deviations and in m.
    """
    weights, slow = 1.0 / variances, np.zeros(n_groups)
    total, moments = np.bincount(group, weights, n_groups), np.bincount(group, weights * residuals, n_groups)
    if len(drift):
        slow = np.bincount(group, weights * drift, n_groups)
    there, total = total > 0.0, np.where(total > 0.0, total, 1.0)
    return there & (np.abs(moments / total) > np.maximum(sigmas * np.sqrt((1.0 + slow) / total), least))


@njit(cache=True)
def along_normal(points, covariances, frame):
    """Distances (N,) of points from a plane, m, and their variances, m^2."""
    n = points.shape[0]
    distances, variances = np.empty(n), np.empty(n)
    nx, ny, nz = frame[0, 2], frame[1, 2], frame[2, 2]
    for k in range(n):
        c = covariances[k]
        x, y, z = points[k, 0] - frame[0, 3], points[k, 1] - frame[1, 3], points[k, 2] - frame[2, 3]
        distances[k] = x * nx + y * ny + z * nz
        across = nx * (c[0, 0] * nx + (c[0, 1] + c[1, 0]) * ny + (c[0, 2] + c[2, 0]) * nz)
        across += ny * (c[1, 1] * ny + (c[1, 2] + c[2, 1]) * nz) + nz * c[2, 2] * nz
        variances[k] = across
    return distances, variances


@njit(cache=True)
def within(points, nearest, farthest):
    """Points (N, 3) with NaN for those whose distance does not lie between two limits, m, or is not finite."""
    result = np.empty_like(points)
    for k in range(points.shape[0]):
        distance = np.sqrt(points[k, 0] ** 2 + points[k, 1] ** 2 + points[k, 2] ** 2)
        for i in range(3):
            result[k, i] = points[k, i] if nearest < distance < farthest else np.nan
    return result
