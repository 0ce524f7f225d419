"""From labelled points to planes: maximum-likelihood frames, covariances with their shared parts, outlines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spplanes._check import FloatArray
from spplanes._rows import NO_VIEWPOINT, OK
from spplanes.fitting import _pose_error
from spplanes.fitting._groups import fit_groups
from spplanes.fitting._job import FitJob, group_by_label
from spplanes.fitting._moment_patches import eigenvalues
from spplanes.moments import row_frame
from spplanes.outlines import outline
from spplanes.plane import Plane
from spplanes.segmentation.clustering.growing import fit_regions
from spplanes.segmentation.config import FEW_ROWS, MapperConfig

if TYPE_CHECKING:
    from shapely import Polygon

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
    if n_regions == 0:
        return []
    rows = moments_of(points, covariance, labels, config)
    eyes = _eyes(labels, n_regions, views)
    frames, spreads = frames_of(rows, eyes)
    if len(points) < FEW_ROWS or covariance.shape[2] == 9:
        _maximise_likelihood(points, covariance, labels, eyes, frames, rows, spreads)
    covariances = np.zeros((n_regions, 3, 3))
    covariances[:, (0, 1, 2), (0, 1, 2)] = 1.0 / spreads
    covariances[:, (0, 1, 2), (0, 1, 2)] += config.surface_sigma_m**2 * rows[:, 1:2] / spreads
    if poses is not None:
        covariances += _shared_parts(points, covariance, labels, frames, spreads, *poses, config.pose_decay)
    polygons = outlines_in(frames, points, labels, np.sqrt(spreads[:, 1:] / rows[:, 1:2]), config)
    chi2 = [eigenvalues(row)[0] for row in rows]
    return [
        Plane._trusted(frames[r], covariances[r], int(rows[r, 0]), polygons[r], float(chi2[r]))
        for r in range(n_regions)
    ]


def moments_of(points: FloatArray, covariance: FloatArray, labels: np.ndarray, config: MapperConfig) -> FloatArray:
    """Moments of the points of every region, weighted along its normal, shape (R, 11); arguments as of `planes_of`."""
    n_regions = int(labels.max(initial=-1)) + 1
    rows = np.zeros((n_regions, 11))
    rows[:, 5], rows[:, 8] = 1.0, 2.0
    isotropic = covariance.shape[2] == 1  # then weights do not wait for a normal
    for floor in (0.0, 0.0) if isotropic else (config.flatness_m**2, 0.0, 0.0):
        rows = fit_regions(points, covariance, labels, rows, np.zeros_like(rows), floor)
    return rows


def _maximise_likelihood(points, covariance, labels, eyes, frames, rows, spreads) -> None:
    """Give the planes their maximum-likelihood frames and spreads, in place.

    The least eigenvalue of a scatter with given weights takes in the noise along the plane as well. Along slanted beams
    that turns the normal by as much as the noise does (measured on the simulated corridor: mean NEES 5.3 for 3.7 of
    the same labels); in strips as narrow as their noise is wide, to anywhere.
    """
    noise = covariance if covariance.shape[2] == 9 else covariance * np.eye(3).ravel()
    job = FitJob(points.reshape(-1, 3), noise.reshape(-1, 3, 3), 1, NO_VIEWPOINT, "ml", None, None)
    numbers, order, bounds = group_by_label(labels.ravel(), labels.size)
    fits = fit_groups(job, order, bounds, eyes[numbers])
    good = fits.status == OK  # a line of points keeps the frame it has
    frames[numbers[good]] = fits.frames[good]
    spreads[numbers[good]] = 1.0 / np.diagonal(fits.covariances[good], axis1=1, axis2=2)
    rows[numbers[good], 1] = spreads[numbers[good], 0]


def _eyes(labels: np.ndarray, n_regions: int, views: FloatArray | None) -> FloatArray:
    """Mean viewpoint of the points of every region, shape (R, 3); NaN without viewpoints."""
    if views is None:
        return np.full((n_regions, 3), np.nan)
    codes = (labels + np.arange(len(labels))[:, None] * n_regions)[labels >= 0]
    shares = np.bincount(codes, minlength=len(labels) * n_regions).reshape(len(labels), n_regions)
    return (shares.T @ views) / shares.sum(axis=0)[:, None]


def frames_of(rows: FloatArray, eyes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Plane frames (R, 4, 4) and the diagonal of the information of (z, theta, psi): (R, 3)."""
    frames, spreads, values = np.empty((len(rows), 4, 4)), np.empty((len(rows), 3)), np.empty(3)
    for r, row in enumerate(rows):
        row_frame(row, eyes[r], frames[r], values)
        spreads[r] = row[1], values[2], values[1]
    return frames, spreads


def _shared_parts(points, covariance, labels, frames, spreads, pose_covariances, origins, decay) -> FloatArray:
    """What the pose errors of the scans add to the covariances of the planes, shape (R, 3, 3)."""
    planes = np.concatenate((frames[:, :3, 2], np.zeros((len(frames), 1))), axis=1)
    anchors = np.ascontiguousarray(frames[:, :3, 3])
    total, running = np.zeros((len(frames), 4, 4)), np.zeros((len(frames), 6, 4))
    roots = _pose_error.roots(pose_covariances)
    _pose_error.accumulate(points, covariance, labels, planes, anchors, roots, origins, decay, total, running)
    parts = [_pose_error.covariance_of(*region) for region in zip(frames, spreads, anchors, total, strict=True)]
    return np.array(parts).reshape(-1, 3, 3)


def outlines_in(
    frames: FloatArray, points: FloatArray, labels: np.ndarray, extents: FloatArray, config: MapperConfig
) -> list[Polygon]:
    """Outline of every region: its quads on a raster, or a rectangle where it is finer than that.

    Args:
        frames: of the planes the outlines are drawn in, shape (R, 4, 4).
        points: shape (S, B, 3), m.
        labels: shape (S, B), 0..R-1, -1 = none.
        extents: standard deviations of the points along x and y, shape (R, 2), m.
        config: cells.
    """
    if not len(frames):
        return []
    cell = np.minimum(config.outline_cell_m, extents[:, 1] / CELLS_PER_EXTENT)
    polygons = outline.outlines_of_grid(points, labels, frames, cell)
    return [polygon or outline.outline_from_extent(*(np.sqrt(3.0) * extents[r])) for r, polygon in enumerate(polygons)]
