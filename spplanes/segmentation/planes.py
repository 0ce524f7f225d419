"""From labelled points to planes: maximum-likelihood frames, covariances with their shared parts, outlines."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes import outline
from spplanes._check import FloatArray
from spplanes.moments import row_frame
from spplanes.plane import Plane
from spplanes.segmentation._patches import eigenvalues, normal_of, variance_along
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.growing import fit_regions

#: A region's outline has at least this many cells across its smaller rms extent.
CELLS_PER_EXTENT = 8.0


def planes_of(
    points: FloatArray,
    covariance: FloatArray,
    labels: np.ndarray,
    views: FloatArray | None,
    poses: tuple[FloatArray, FloatArray] | None,
    config: MapperConfig,
) -> list[Plane]:
    """The planes of a labelled grid.

    Args:
        points: shape (S, B, 3), m.
        covariance: shape (S, B, 1) or (S, B, 9), m^2.
        labels: shape (S, B), 0..K-1, -1 = none.
        views: viewpoint of every row, shape (S, 3), m, or None for d >= 0.
        poses: pose covariances (S, 6, 6) and the points they turn about (S, 3), or None.
        config: flatness and outlines.
    """
    n_regions = int(labels.max(initial=-1)) + 1
    rows = np.zeros((n_regions, 11))
    rows[:, 5], rows[:, 8] = 1.0, 2.0
    for floor in (config.flatness_m**2, 0.0, 0.0):
        rows = fit_regions(points, covariance, labels, rows, np.zeros_like(rows), floor)
    frames, spreads = _frames(rows, _eyes(rows, points, labels, views))
    covariances = np.zeros((n_regions, 3, 3))
    covariances[:, (0, 1, 2), (0, 1, 2)] = 1.0 / spreads
    covariances[:, (0, 1, 2), (0, 1, 2)] += config.surface_sigma_m**2 * rows[:, 1:2] / spreads
    if poses is not None:
        covariances += shared_pose_covariance(points, covariance, labels, frames, spreads, *poses)
    polygons = _outlines(points, labels, rows, frames, spreads, config)
    chi2 = [eigenvalues(row)[0] for row in rows]
    return [
        Plane._trusted(frames[r], covariances[r], int(rows[r, 0]), polygons[r], float(chi2[r]))
        for r in range(n_regions)
    ]


def _eyes(rows: FloatArray, points: FloatArray, labels: np.ndarray, views: FloatArray | None) -> FloatArray:
    """A point on the side every region was seen from, shape (R, 3); NaN without viewpoints."""
    if views is None:
        return np.full((len(rows), 3), np.nan)
    return np.stack([_eye(row, views, share) for row, share in zip(rows, _shares(labels, len(rows)), strict=True)])


def _shares(labels: np.ndarray, n_regions: int) -> np.ndarray:
    """Number of points of every region in every row of the grid, shape (R, S)."""
    codes = (labels + np.arange(len(labels))[:, None] * n_regions)[labels >= 0]
    return np.bincount(codes, minlength=len(labels) * n_regions).reshape(len(labels), n_regions).T


def _eye(row: FloatArray, views: FloatArray, share: np.ndarray) -> FloatArray:
    """Centre plus the normal on the side on which most points were seen."""
    normal = np.array(normal_of(row, eigenvalues(row)[0]))
    side = np.sign(np.sum(share * ((views - row[2:5]) @ normal)))
    return row[2:5] + (side or 1.0) * normal


def _frames(rows: FloatArray, eyes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Plane frames (R, 4, 4) and the diagonal of the information of (z, theta, psi): (R, 3)."""
    frames, spreads, values = np.empty((len(rows), 4, 4)), np.empty((len(rows), 3)), np.empty(3)
    for r, row in enumerate(rows):
        row_frame(row, eyes[r], frames[r], values)
        spreads[r] = row[1], values[2], values[1]
    return frames, spreads


@njit(cache=True)
def shared_by_scan(points, pose_covariances, origins):
    """Covariance that the pose error of its scan gives every point, shape (S, B, 9); the points share that error."""
    result = np.empty((points.shape[0], points.shape[1], 9))
    jacobian = np.zeros((3, 6))
    jacobian[0, 0] = jacobian[1, 1] = jacobian[2, 2] = 1.0
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            x, y, z = points[i, j, 0] - origins[i, 0], points[i, j, 1] - origins[i, 1], points[i, j, 2] - origins[i, 2]
            jacobian[0, 3], jacobian[1, 3] = -y, x
            jacobian[0, 4], jacobian[2, 4] = z, -x
            jacobian[1, 5], jacobian[2, 5] = -z, y
            result[i, j] = (jacobian @ pose_covariances[i] @ jacobian.T).ravel()
    return result


@njit(cache=True)
def shared_pose_covariance(points, covariance, labels, frames, spreads, pose_covariances, origins):
    """What the pose errors of the rows of the grid, each shared by its points, add: sum_s G_s S_s G_s^T, (R, 3, 3).

    The pose error of row s is a world-side differential (x, y, z, phi, theta, psi) that turns about origins[s].
    """
    n_regions = frames.shape[0]
    total = np.zeros((n_regions, 3, 3))
    gain = np.zeros((n_regions, 3, 6))
    for i in range(labels.shape[0]):
        gain[:] = 0.0
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r >= 0:
                _add_gain(gain[r], points[i, j], covariance[i, j], frames[r], origins[i])
        for r in range(n_regions):
            if gain[r].any():
                for k in range(3):
                    gain[r, k] *= (-1.0 if k == 1 else 1.0) / spreads[r, k]
                total[r] += gain[r] @ pose_covariances[i] @ gain[r].T
    return total


@njit(cache=True)
def _add_gain(gain, p, covariance, frame, origin):
    """Add w h (n^T dp/dxi) of one point, h = (1, x, y) in plane coordinates, to gain (3, 6)."""
    nx, ny, nz = frame[0, 2], frame[1, 2], frame[2, 2]
    w = 1.0 / variance_along(covariance, nx, ny, nz)
    cx, cy, cz = p[0] - frame[0, 3], p[1] - frame[1, 3], p[2] - frame[2, 3]
    x = cx * frame[0, 0] + cy * frame[1, 0] + cz * frame[2, 0]
    y = cx * frame[0, 1] + cy * frame[1, 1] + cz * frame[2, 1]
    px, py, pz = p[0] - origin[0], p[1] - origin[1], p[2] - origin[2]
    turn_x, turn_y, turn_z = py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx
    for k in range(3):
        h = w * (1.0 if k == 0 else (x if k == 1 else y))
        gain[k, 0] += h * nx
        gain[k, 1] += h * ny
        gain[k, 2] += h * nz
        gain[k, 3] += h * turn_z
        gain[k, 4] += h * turn_y
        gain[k, 5] += h * turn_x


def _outlines(points, labels, rows, frames, spreads, config) -> list:
    """Outline of every region: its quads on a raster, or a rectangle where it is finer than that."""
    extents = np.sqrt(spreads[:, 1:] / rows[:, 1:2])
    cell = np.minimum(config.outline_cell_m, extents[:, 1] / CELLS_PER_EXTENT)
    axes = np.array([outline.projection_axis(*frame[:3, 2]) for frame in frames], dtype=np.int64)
    region, cells = outline.cells_of(np.unique(_draw_grid(points, labels, axes, cell)))
    parts = np.split(cells, np.searchsorted(region, np.arange(1, len(rows))))
    polygons = []
    for r in range(len(rows)):
        polygon = outline.outline_from_cells(parts[r], cell[r], int(axes[r]), frames[r])
        polygons.append(polygon or outline.outline_from_extent(*(np.sqrt(3.0) * extents[r])))
    return polygons


@njit(cache=True)
def _draw_grid(points, labels, axes, cell):
    """Cells of all regions of a grid, with a few repeated, as keys."""
    keys, count = np.empty(labels.size // 4 + 16, dtype=np.int64), 0
    for i in range(labels.shape[0] - 1):
        keys, count = outline.draw_quads(points[i], points[i + 1], labels[i], labels[i + 1], axes, cell, keys, count)
    return keys[:count]
