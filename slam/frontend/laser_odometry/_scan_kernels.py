"""Kernels of laser odometry: the surface a scan shows, and the local map's points in cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from slam.frontend.occupancy.raster import GAP_STEPS, LEAST_GAP_M
from spplanes._check import FloatArray
from spplanes._jit import inlined, njit


class Cells(NamedTuple):
    """Points of a map, found by the square cells that they lie in."""

    points: FloatArray
    """Shape (M, 2), m, cell by cell."""
    normals: FloatArray
    """Shape (M, 2)."""
    weights: FloatArray
    """How firmly each lies where it does, shape (M,)."""
    start: np.ndarray
    """Where the points of each cell begin, shape (rows * columns + 1,)."""
    origin: FloatArray
    """Corner of the first cell, shape (2,), m."""
    cell: float
    """Side of a cell, m."""
    columns: int
    """Number of cells in a row."""
    rows: int
    """Number of rows."""


@njit(cache=True)
def surface_of(points, away, angle_step, range_variance, surface_variance, correlation_m):
    """Normals and noise of the returns (B, 2) of one scan, seen from `away` (B, 2), the sensor's place less each.

    A normal is fitted to the neighbours in the order of the beams that lie on one surface: no further apart than
    `GAP_STEPS` of the beams at their range, or `LEAST_GAP_M`. Returns that lie alone have none.

    Returns:
        normals (B, 2), toward the sensor, NaN without; variance (B,) of a return along its normal, m^2; looks (B,): the
        share of an independent look at the surface that a return is, for the unevenness of a wall is alike nearby;
        turns (B,): the square of the sine by which a normal is expected to err.
    """
    count = points.shape[0]
    normals = np.full((count, 2), np.nan)
    variance, looks, turns = np.zeros(count), np.zeros(count), np.zeros(count)
    for i in range(count):
        reach = np.sqrt(away[i, 0] ** 2 + away[i, 1] ** 2)
        low, high = _neighbours(points, i, max(LEAST_GAP_M, GAP_STEPS * reach * angle_step))
        number = high - low + 1
        if number < 3:
            continue
        xx, xy, yy = _spread(points, low, high)
        half, root = 0.5 * (xx - yy), np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        smallest = max(0.5 * (xx + yy) - root, 0.0) / (number - 2)
        angle = 0.5 * np.arctan2(2.0 * xy, 2.0 * half)
        nx, ny = -np.sin(angle), np.cos(angle)
        if nx * away[i, 0] + ny * away[i, 1] < 0.0:
            nx, ny = -nx, -ny
        normals[i, 0], normals[i, 1] = nx, ny
        spacing = np.sqrt((points[high, 0] - points[low, 0]) ** 2 + (points[high, 1] - points[low, 1]) ** 2)
        spacing = max(spacing / (number - 1), 1e-3)
        alike = max(1.0, correlation_m / spacing)
        variance[i] = max(range_variance, smallest) + surface_variance
        looks[i] = variance[i] / (max(range_variance, smallest) + surface_variance * alike)
        turns[i] = 0.5 * (1.0 - np.exp(-2.0 * variance[i] / (looks[i] * (0.5 * (xx + yy) + root))))
    return normals, variance, looks, turns


@inlined
def _neighbours(points, i, gap):
    """The first and the last return of the surface that one lies on, without a gap between: five to either side."""
    count, low, high, most, patch_m = points.shape[0], i, i, 5, 0.25
    while low > 0 and i - low < most and _apart(points, low, low - 1) < gap and _apart(points, i, low) < patch_m:
        low -= 1
    while (
        high < count - 1
        and high - i < most
        and _apart(points, high, high + 1) < gap
        and _apart(points, i, high) < patch_m
    ):
        high += 1
    return low, high


@inlined
def _apart(points, i, j):
    return np.sqrt((points[i, 0] - points[j, 0]) ** 2 + (points[i, 1] - points[j, 1]) ** 2)


@inlined
def _spread(points, low, high):
    """Sums of squares and products of points from one to another about their mean: xx, xy, yy."""
    number = high - low + 1
    mx = my = 0.0
    for k in range(low, high + 1):
        mx += points[k, 0]
        my += points[k, 1]
    mx, my = mx / number, my / number
    xx = xy = yy = 0.0
    for k in range(low, high + 1):
        dx, dy = points[k, 0] - mx, points[k, 1] - my
        xx, xy, yy = xx + dx * dx, xy + dx * dy, yy + dy * dy
    return xx, xy, yy


@njit(cache=True)
def nearness(points, origin, cell, columns, rows):
    """How near each cell (rows, columns) is to a point: exp(-d^2 / 2 cell^2), 0 beyond three cells."""
    table = np.zeros((rows, columns))
    reach = 3
    for k in range(points.shape[0]):
        column, row = int((points[k, 0] - origin[0]) / cell), int((points[k, 1] - origin[1]) / cell)
        for r in range(max(row - reach, 0), min(row + reach + 1, rows)):
            for c in range(max(column - reach, 0), min(column + reach + 1, columns)):
                dx = origin[0] + (c + 0.5) * cell - points[k, 0]
                dy = origin[1] + (r + 0.5) * cell - points[k, 1]
                near = np.exp(-0.5 * (dx * dx + dy * dy) / (cell * cell))
                if near > table[r, c]:
                    table[r, c] = near
    return table
