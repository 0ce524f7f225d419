"""Range images of clouds: how many of their cells a shape fills, and the nearest point of every cell."""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import njit

#: Powers of so many points fit beside each other into the nearest memory.
_BLOCK = 128


@njit(cache=True)
def returns_of(points):
    """The points (N, 3) that are finite and not at the sensor, in their order."""
    result, count = np.empty((points.shape[0], 3)), 0
    for k in range(points.shape[0]):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        if np.isfinite(x) and np.isfinite(y) and np.isfinite(z) and (x != 0.0 or y != 0.0 or z != 0.0):
            result[count, 0], result[count, 1], result[count, 2] = x, y, z
            count += 1
    return result[:count]


def turns_of(points: FloatArray) -> FloatArray:
    """Cosine of the angle from every point to the next as seen from the origin, shape (N - 1,)."""
    x, y, z = points.T
    length = np.sqrt(x * x + y * y + z * z)
    along = x[1:] * x[:-1] + y[1:] * y[:-1] + z[1:] * z[:-1]
    return np.clip(along / (length[:-1] * length[1:]), -1.0, 1.0)


def rows_of(elevation: FloatArray, highest: float, lowest: float, rows: int) -> np.ndarray:
    """Row of every elevation (N,), int32: highest and lowest lie in the middle of the first row and the last."""
    return np.rint((highest - elevation) * ((rows - 1) / max(highest - lowest, 1e-9))).astype(np.int32)


def phases_of(azimuth: FloatArray, columns: np.ndarray) -> FloatArray:
    """Where in their column beams lie on average, for every number of columns (C,) in a whole turn, (C,), columns."""
    return np.arctan2(*_power_sums(azimuth, columns).T[::-1]) / (2.0 * np.pi)


@njit(cache=True)
def _power_sums(azimuth, columns):
    """Sums of e^(i n azimuth), (C, 2), for every number n of columns (C,): of that direction is the average phase.

    The powers come from squares of the first, for a block of points at a time.
    """
    sums, most = np.zeros((columns.shape[0], 2)), 0
    for count in columns:
        most = max(most, count)
    bits = int(np.ceil(np.log2(most + 1.0)))
    square, power = np.empty((bits, 2, _BLOCK)), np.empty((2, _BLOCK))
    for start in range(0, azimuth.shape[0], _BLOCK):
        size = min(_BLOCK, azimuth.shape[0] - start)
        for k in range(size):
            square[0, 0, k], square[0, 1, k] = np.cos(azimuth[start + k]), np.sin(azimuth[start + k])
        for bit in range(1, bits):
            for k in range(size):
                real, imaginary = square[bit - 1, 0, k], square[bit - 1, 1, k]
                square[bit, 0, k] = real * real - imaginary * imaginary
                square[bit, 1, k] = real * imaginary + imaginary * real
        for c in range(columns.shape[0]):
            for k in range(size):
                power[0, k], power[1, k] = 1.0, 0.0
            for bit in range(bits):
                if columns[c] >> bit & 1:
                    for k in range(size):
                        real = power[0, k] * square[bit, 0, k] - power[1, k] * square[bit, 1, k]
                        power[1, k] = power[0, k] * square[bit, 1, k] + power[1, k] * square[bit, 0, k]
                        power[0, k] = real
            for k in range(size):
                sums[c, 0] += power[0, k]
                sums[c, 1] += power[1, k]
    return sums


def columns_of(azimuth: FloatArray, columns: int, phase: float) -> np.ndarray:
    """Column of every azimuth (N,), rad, of so many in a whole turn, int32: those at the phase lie in the middle."""
    return np.rint(azimuth * (columns / (2.0 * np.pi)) - phase).astype(np.int32) % np.int32(columns)


@njit(cache=True)
def occupied_cells(row, column, rows, columns):
    """Number of the cells of an image that hold a point, by rows and columns (N,) of the points."""
    seen, count = np.zeros(rows * columns, np.bool_), 0
    for k in range(row.shape[0]):
        cell = row[k] * columns + column[k]
        count += not seen[cell]
        seen[cell] = True
    return count


@njit(cache=True)
def nearest(row, column, ranges, rows, cols):
    """Number of the nearest point of every cell, -1 = none; of equal ranges the first."""
    index = np.empty((rows, cols), dtype=np.int64)
    for i in range(rows):
        for j in range(cols):
            index[i, j] = -1
    for k in range(row.shape[0]):
        best = index[row[k], column[k]]
        if best < 0 or ranges[k] < ranges[best]:
            index[row[k], column[k]] = k
    return index


def nearest_points(points: FloatArray, row: np.ndarray, column: np.ndarray, rows: int, columns: int) -> FloatArray:
    """Image (rows, columns, 3) of points (N, 3): of those in one cell the nearest, of equal ones the last."""
    backwards = points[::-1]
    x, y, z = backwards.T
    index = nearest(row[::-1].astype(np.int64), column[::-1].astype(np.int64), x**2 + y**2 + z**2, rows, columns)
    return np.where((index >= 0)[..., None], backwards[index], np.nan)
