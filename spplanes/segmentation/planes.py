"""From labelled points to planes: maximum-likelihood frames, covariances with their shared parts, outlines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from spplanes._check import FloatArray
from spplanes._rows import NO_VIEWPOINT, OK
from spplanes.fitting import _pose_error
from spplanes.fitting._groups import FitJob, fit_groups, group_by_label
from spplanes.fitting._moment_patches import eigenvalues
from spplanes.fitting.seams import along_beams, at_seams, placed
from spplanes.fitting.shared_error import shared_error_of
from spplanes.moments import row_frame
from spplanes.outlines.outline import outline_from_extent, outlines_of_grid
from spplanes.plane import Plane
from spplanes.segmentation.clustering.growing import fit_regions
from spplanes.segmentation.config import FEW_ROWS, MapperConfig

if TYPE_CHECKING:
    from shapely import Polygon


@dataclass(frozen=True, eq=False)
class FittedPlanes:
    """Planes of labelled points, without outlines."""

    frames: FloatArray
    """World_T_plane, shape (R, 4, 4)."""
    extents: FloatArray
    """Standard deviations of the points along x and y, shape (R, 2), m."""
    covariances: FloatArray
    """Of (z, theta, psi), shape (R, 3, 3)."""
    counts: np.ndarray
    """Points of each, shape (R,)."""
    chi2: FloatArray
    """Sum of squared normalised residuals, shape (R,)."""
    octave_sigma_m: float
    """Standard deviation of an octave of the error that neighbouring points share, m."""
    noise_factor: float
    """Median variance of the points about their planes over what was given."""

    def with_outlines(self, outlines: Sequence[Polygon]) -> list[Plane]:
        """The planes."""
        counts, chi2 = self.counts.astype(int).tolist(), self.chi2.tolist()
        return [Plane._trusted(*one) for one in zip(self.frames, self.covariances, counts, outlines, chi2, strict=True)]


def planes_of(
    points: FloatArray,
    covariance: FloatArray,
    labels: np.ndarray,
    views: FloatArray | None,
    poses: tuple[FloatArray, FloatArray] | None,
    config: MapperConfig,
) -> list[Plane]:
    """The planes of a labelled grid; `views` None: d >= 0; `poses`: pose covariances (S, 6, 6) and the points they turn
    about (S, 3), or None; of `config` outlines and the least shared error."""
    eyes, seen_from = np.full((int(labels.max(initial=-1)) + 1, 3), np.nan), None
    if views is not None:  # of a plane the mean over its points
        shares, seen_from = shares_of(labels, len(eyes)), views[:, None]
        eyes = (shares.T @ views) / shares.sum(axis=0)[:, None]
    fitted = fit_labelled(points, covariance, labels, eyes, config, views=seen_from, poses=poses)
    return fitted.with_outlines(outlines_in(fitted.frames, points, labels, fitted.extents, config))


def fit_labelled(
    points: FloatArray,
    covariance: FloatArray,
    labels: np.ndarray,
    eyes: FloatArray,
    config: MapperConfig,
    *,
    views: FloatArray | None = None,
    poses: tuple[FloatArray, FloatArray] | None = None,
    stated: bool = True,
) -> FittedPlanes:
    """Planes of labelled points with all that their errors share, each seen from `eyes` (R, 3), m, NaN for d >= 0;
    `views` are (S, B, 3) or (S, 1, 3), m, or None: nobody knows. If not `stated`, residuals may lower the
    covariance."""
    if not len(eyes):
        none = np.empty(0)
        return FittedPlanes(np.empty((0, 4, 4)), np.empty((0, 2)), np.empty((0, 3, 3)), none, none, 0.0, 1.0)
    every = moments_of(points, covariance, labels, config)
    points, labels = _away_from_seams(points, covariance, labels, frames_of(every, eyes)[0], views)
    rows = moments_of(points, covariance, labels, config)
    frames, spreads = frames_of(rows, eyes)
    if 1 < len(points) < FEW_ROWS or covariance.shape[2] == 9:
        _maximise_likelihood(points, covariance, labels, eyes, frames, rows, spreads)
    covariances = np.zeros((len(eyes), 3, 3))
    covariances[:, (0, 1, 2), (0, 1, 2)] = 1.0 / spreads
    flat = points.reshape(-1, 3), covariance.reshape(-1, covariance.shape[2]), labels.ravel()
    estimate = poses is None  # what scans share by their poses shows in the residuals as well, and is known
    least_m = config.surface_sigma_m
    shared = shared_error_of(*flat, frames, covariances, stated=stated, least_m=least_m, estimate=estimate)
    covariances = shared.covariances
    if poses is not None:
        grid, (pose_covariances, origins) = (points, covariance, labels), poses
        planes = np.concatenate((frames[:, :3, 2], np.zeros((len(frames), 1))), axis=1)
        anchors = np.ascontiguousarray(frames[:, :3, 3])
        total, running = np.zeros((len(frames), 4, 4)), np.zeros((len(frames), 6, 4))
        errors = _pose_error.roots(pose_covariances), origins, config.pose_decay
        _pose_error.accumulate(grid, (planes, anchors), errors, total, running)
        parts = [_pose_error.covariance_of(*region) for region in zip(frames, spreads, anchors, total, strict=True)]
        covariances = covariances + np.array(parts)
    extents = np.sqrt(spreads[:, 1:] / rows[:, 1:2])
    chi2 = np.array([eigenvalues(row)[0] for row in every])
    factor = float(np.median(shared.noise_factors))
    return FittedPlanes(frames, extents, covariances, every[:, 0], chi2, shared.octave_sigma_m, factor)


def _away_from_seams(
    points: FloatArray, covariance: FloatArray, labels: np.ndarray, frames: FloatArray, views: FloatArray | None
) -> tuple[FloatArray, np.ndarray]:
    """Points where beams meet their planes, and labels without those that may be of another plane as well; a plane
    keeps all of its points where fewer than half would be left: it lies beside another one everywhere."""
    noise = covariance
    if views is not None and covariance.shape[2] == 1:
        noise = covariance * along_beams(points, views)
        points = placed(points, noise, labels, frames)
    sure = np.where(at_seams(points, noise, labels, frames), -1, labels)
    whole, left = (np.bincount(some[some >= 0], minlength=len(frames)) for some in (labels, sure))
    kept = np.append(left < np.maximum(0.5 * whole, 3), False)
    return points, np.where(kept[labels], labels, sure)


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
    job = FitJob(points.reshape(-1, 3), noise.reshape(-1, 3, 3), NO_VIEWPOINT)
    numbers, order, bounds = group_by_label(labels.ravel(), labels.size)
    fits = fit_groups(job, order, bounds, eyes[numbers])
    good = fits.status == OK  # a line of points keeps the frame it has
    frames[numbers[good]] = fits.frames[good]
    spreads[numbers[good]] = 1.0 / np.diagonal(fits.covariances[good], axis1=1, axis2=2)
    rows[numbers[good], 1] = spreads[numbers[good], 0]


def shares_of(labels: np.ndarray, n_regions: int) -> np.ndarray:
    """Number of points of every region in every row of labels (S, B), shape (S, n_regions)."""
    codes = (labels + np.arange(len(labels))[:, None] * n_regions)[labels >= 0]
    return np.bincount(codes, minlength=len(labels) * n_regions).reshape(len(labels), n_regions)


def frames_of(rows: FloatArray, eyes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Plane frames (R, 4, 4) and the diagonal of the information of (z, theta, psi): (R, 3)."""
    frames, spreads, values = np.empty((len(rows), 4, 4)), np.empty((len(rows), 3)), np.empty(3)
    for r, row in enumerate(rows):
        row_frame(row, eyes[r], frames[r], values)
        spreads[r] = row[1], values[2], values[1]
    return frames, spreads


def outlines_in(
    frames: FloatArray, points: FloatArray, labels: np.ndarray, extents: FloatArray, config: MapperConfig
) -> list[Polygon]:
    """Outline of every region in its frame: its quads on a raster, or a rectangle where it is finer than that.
    `extents` (R, 2), m, are the standard deviations of the points along x and y."""
    if not len(frames):
        return []
    return or_rectangles(outlines_of_grid(points, labels, frames, cells_of(extents, config)), extents)


def cells_of(extents: FloatArray, config: MapperConfig) -> FloatArray:
    """Sides of the cells in which outlines of planes of such extents (R, 2), m, are drawn, (R,), m: eight at least."""
    return np.minimum(config.outline_cell_m, extents[:, 1] / 8.0)


def or_rectangles(outlines: Sequence[Polygon | None], extents: FloatArray) -> list[Polygon]:
    """Outlines, or rectangles of their extents (R, 2), m, where there are none."""
    return [
        outline or outline_from_extent(*(3.0**0.5 * extent)) for outline, extent in zip(outlines, extents, strict=True)
    ]
