"""Range images of clouds: how many of their cells a shape fills, and the nearest point of every cell."""

from __future__ import annotations

import numpy as np

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


@njit(cache=True)
def turns_of(points):
    """Cosine of the angle from every point to the next as seen from the origin, shape (N - 1,)."""
    cosines, before = np.empty(max(points.shape[0] - 1, 0)), 0.0
    for k in range(points.shape[0]):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if k > 0:
            along = x * points[k - 1, 0] + y * points[k - 1, 1] + z * points[k - 1, 2]
            cosines[k - 1] = min(max(along / (before * length), -1.0), 1.0)
        before = length
    return cosines


@njit(cache=True)
def rows_of(elevation, highest, lowest, rows):
    """Row of every elevation (N,), int32: highest and lowest lie in the middle of the first row and the last."""
    scale = (rows - 1) / max(highest - lowest, 1e-9)
    result = np.empty(elevation.shape[0], np.int32)
    for k in range(result.shape[0]):
        result[k] = np.int32(np.rint((highest - elevation[k]) * scale))
    return result


@njit(cache=True)
def phases_of(azimuth, columns):
    """Where in their column beams lie on average, for every number of columns (C,) in a whole turn, (C,), columns.

    With n columns that is the direction of the sum of e^(i n azimuth); the powers come from squares of the first, for a
    block of points at a time.
    """
    sums = np.zeros((2, columns.shape[0]))
    bits = int(np.ceil(np.log2(columns.max() + 1.0)))
    square, power = np.empty((bits, 2, _BLOCK)), np.empty((2, _BLOCK))
    for start in range(0, azimuth.shape[0], _BLOCK):
        size = min(_BLOCK, azimuth.shape[0] - start)
        for k in range(size):
            square[0, 0, k], square[0, 1, k] = np.cos(azimuth[start + k]), np.sin(azimuth[start + k])
        for bit in range(1, bits):
            square[bit] = square[bit - 1]
            _multiply(square[bit], square[bit - 1], size)
        for c in range(columns.shape[0]):
            power[0], power[1] = 1.0, 0.0
            for bit in range(bits):
                if columns[c] >> bit & 1:
                    _multiply(power, square[bit], size)
            for k in range(size):
                sums[0, c] += power[0, k]
                sums[1, c] += power[1, k]
    return np.arctan2(sums[1], sums[0]) / (2.0 * np.pi)


@njit(cache=True)
def _multiply(one, other, size):
    """Multiply complex numbers (2, N), real and imaginary parts, by others, in place."""
    for k in range(size):
        real = one[0, k] * other[0, k] - one[1, k] * other[1, k]
        one[1, k] = one[0, k] * other[1, k] + one[1, k] * other[0, k]
        one[0, k] = real


@njit(cache=True)
def columns_of(azimuth, columns, phase):
    """Column of every azimuth (N,), rad, of so many in a whole turn, int32: those at the phase lie in the middle."""
    per_rad, turn = columns / (2.0 * np.pi), np.int32(columns)
    result = np.empty(azimuth.shape[0], np.int32)
    for k in range(result.shape[0]):
        column = np.int32(np.rint(azimuth[k] * per_rad - phase))
        column += turn if column < 0 else np.int32(0)
        result[k] = column - (turn if column >= turn else np.int32(0))
    return result


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
def nearest_points(points, row, column, rows, columns):
    """Image (rows, columns, 3) of points (N, 3): of those in one cell the nearest, of equal ones the last."""
    image, best = np.full((rows, columns, 3), np.nan), np.full((rows, columns), np.inf)
    for k in range(points.shape[0]):
        i, j = row[k], column[k]
        squared = points[k, 0] ** 2 + points[k, 1] ** 2 + points[k, 2] ** 2
        if squared <= best[i, j]:
            best[i, j] = squared
            for c in range(3):
                image[i, j, c] = points[k, c]
    return image
