"""Unorganised clouds become range images round a viewpoint, so that they go through the same stages."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import as_shape
from spplanes.clouds._arrange_kernels import nearest


def organise(
    points: ArrayLike, viewpoint: ArrayLike = (0.0, 0.0, 0.0), *, rows: int = 64, cols: int = 1024
) -> tuple[np.ndarray, np.ndarray]:
    """Range image of a cloud seen from one viewpoint.

    Rows are equal steps of elevation from the highest point to the lowest, columns equal steps of azimuth from -pi to
    pi. With as many rows as a spinning lidar has evenly spaced beams, each ring falls into a row of its own. Where
    several points fall into one cell the nearest is kept: what is before hides what is behind.

    Args:
        points: shape (N, 3), m; a point that is not finite is ignored.
        viewpoint: shape (3,), m.
        rows: number of steps of elevation, for a spinning lidar its beams.
        cols: number of steps of azimuth.

    Returns:
        grid: shape (rows, cols, 3), m, NaN where no point fell.
        index: shape (rows, cols), int64, the point in each cell, -1 = none.

    Raises:
        ValueError: points of another shape, or rows or cols less than 1.
    """
    cloud = as_shape("points", points, (None, 3), finite=False)
    eye = as_shape("viewpoint", viewpoint, (3,))
    for name, value in (("rows", rows), ("cols", cols)):
        if int(value) < 1:
            raise ValueError(f"{name}: expected at least 1, got {value}")
    rays = cloud - eye
    ranges = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    used = np.flatnonzero(np.isfinite(ranges) & (ranges > 0.0))
    rays, ranges = rays[used], ranges[used]
    row = _bands(np.arcsin(np.clip(rays[:, 2] / ranges, -1.0, 1.0)), int(rows))
    azimuth = np.arctan2(rays[:, 1], rays[:, 0])
    column = np.minimum(((azimuth + np.pi) / (2.0 * np.pi) * cols).astype(np.int64), int(cols) - 1)
    index = nearest(row, column, ranges, int(rows), int(cols))
    index[index >= 0] = used[index[index >= 0]]
    grid = np.where((index >= 0)[..., None], cloud[np.maximum(index, 0)] if len(cloud) else np.nan, np.nan)
    return grid, index


def _bands(elevation: np.ndarray, rows: int) -> np.ndarray:
    """Row of every elevation, 0 = highest; the highest and the lowest lie in the middle of theirs."""
    if not len(elevation):
        return np.empty(0, dtype=np.int64)
    low, high = float(elevation.min()), float(elevation.max())
    if rows == 1 or high == low:
        return np.zeros(len(elevation), dtype=np.int64)
    return np.rint((high - elevation) / (high - low) * (rows - 1)).astype(np.int64)
