"""The input of a plane fit, checked once, its division into groups, and the fit of every group."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_positive, as_shape
from spplanes._jit import njit
from spplanes._rows import NO_VIEWPOINT, OK, ROW_SIZE, TOO_FEW, row_frame
from spplanes._threads import in_parts
from spplanes.fitting import _kernels as kernels
from spplanes.fitting._point_checks import LARGEST_VARIANCE, SMALLEST_VARIANCE, as_covariances, as_points
from spplanes.fitting._pose_error import shared_by_scan
from spplanes.fitting._robust import CUTOFF, FRACTIONS, robust_group
from spplanes.fitting._shared_pose import SharedPose, fit_shared_pose, sp_pose_term
from spplanes.fitting._sums import CHI2, N_SUMS, USED, start_row
from spplanes.plane import Plane

Method = Literal["ml", "sp"]
Robust = Literal["tukey"]


@dataclass(frozen=True, eq=False)
class FitJob:
    """Checked input of a fit; what is given of points, (N, 3), as kernels take it (`spplanes.fitting._sums`)."""

    points: FloatArray
    covariances: FloatArray
    viewpoint: FloatArray
    """Shape (3,), m; NaN for none."""
    method: Method = "ml"
    robust: Robust | None = None
    shared: SharedPose | None = None
    """The pose errors that points of one scan share."""

    @classmethod
    def checked(
        cls,
        points: ArrayLike,
        covariances: ArrayLike | None,
        sigma: float | None,
        method: Method,
        viewpoint: ArrayLike | None,
        robust: Robust | None,
        poses: tuple[ArrayLike | None, ArrayLike | None, ArrayLike | None],
    ) -> FitJob:
        """Check what the caller gave; `poses`: scan of every point, covariances of the scans' poses, their origins."""
        if method not in get_args(Method):
            raise ValueError(f"method: expected one of {get_args(Method)}, got {method!r}")
        if robust not in (None, *get_args(Robust)):
            raise ValueError(f"robust: expected one of {(None, *get_args(Robust))}, got {robust!r}")
        if robust and method == "sp":
            raise ValueError(f"robust: expected None with method 'sp', got {robust!r}")
        array = as_points("points", points)
        noise = _covariances(covariances, sigma, len(array))
        eye = NO_VIEWPOINT if viewpoint is None else as_shape("viewpoint", viewpoint, (3,))
        shared = SharedPose.checked(array, *poses)
        return cls(array, noise, eye, method, robust, shared)

    def select(self, chosen: np.ndarray) -> FitJob:
        """The same for a subset of the points."""
        noise = self.covariances[chosen] if len(self.covariances) > 1 else self.covariances
        shared = self.shared.select(chosen) if self.shared else None
        return replace(self, points=self.points[chosen], covariances=noise, shared=shared)


def _covariances(covariances: ArrayLike | None, sigma: float | None, n: int) -> FloatArray:
    """Covariances of the points, or one for all."""
    if covariances is not None and sigma is None:
        return as_covariances("covariances", covariances, (n,))
    if sigma is not None and covariances is None:
        deviation = as_positive("sigma", sigma)
        if not SMALLEST_VARIANCE**0.5 <= deviation <= LARGEST_VARIANCE**0.5:
            raise ValueError(
                f"sigma: expected {SMALLEST_VARIANCE**0.5:.0e} to {LARGEST_VARIANCE**0.5:.0e} m, got {deviation}"
            )
        return deviation**2 * np.eye(3)[None]
    raise ValueError("covariances: expected either them or sigma, got " + ("neither" if sigma is None else "both"))


def group_by_label(labels: ArrayLike | None, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct labels >= 0 ascending (P,), indices sorted by label, stable, and the groups' bounds (P + 1,)."""
    array = np.asarray(labels)
    if array.size == 0:
        array = array.astype(np.int64)
    if array.shape != (n,) or array.dtype.kind not in "iu":
        raise ValueError(f"labels: expected {n} integers, one for each point, got {array.dtype} of shape {array.shape}")
    narrow = n and array.max() < 1 << 15  # such numbers numpy sorts by counting, in one walk over the points
    codes = np.maximum(array.astype(np.int64, copy=False), -1).astype(np.int16) if narrow else array
    order = np.argsort(codes, kind="stable")
    ranked = array[order]
    first = int(np.searchsorted(ranked, 0))
    starts = first + np.flatnonzero(np.diff(ranked[first:], prepend=-1))
    return ranked[starts], order[first:], np.append(starts, n) - first


@dataclass(frozen=True, eq=False)
class Fits:
    """Outcome of a fit for every group: OK or why not, and of those that are, world_T_plane, (P, 4, 4), the covariances
    (P, 3, 3) of (z, theta, psi), the number of points used, and chi2."""

    status: np.ndarray
    frames: FloatArray
    covariances: FloatArray
    counts: np.ndarray
    chi2: FloatArray

    def planes(self) -> list[Plane]:
        """One plane a group."""
        rows = zip(self.frames, self.covariances, self.counts.tolist(), self.chi2.tolist(), strict=True)
        return [Plane._trusted(frame, covariance, n, None, chi2) for frame, covariance, n, chi2 in rows]


def fit_groups(job: FitJob, order: np.ndarray, bounds: np.ndarray, viewpoints: FloatArray | None = None) -> Fits:
    """Fit every group ``order[bounds[g]:bounds[g + 1]]``, seen from the job's viewpoint or from its own one, (P, 3)."""
    n = len(bounds) - 1
    arrays = np.empty(n, np.int64), np.empty((n, 4, 4)), np.empty((n, 3, 3)), np.empty(n, np.int64), np.empty(n)
    fits = Fits(*arrays)
    if job.shared is None:
        eyes, how = job.viewpoint[None] if viewpoints is None else viewpoints, (job.method == "sp", bool(job.robust))
        inputs = (job.points, job.covariances, order, bounds, eyes)
        largest_first = np.argsort(-np.diff(bounds), kind="stable")
        fit = partial(_run, how, inputs, FRACTIONS, arrays)
        in_parts(lambda first, last: fit(largest_first[first:last]), n, len(order), singly=True)
        return fits
    for g in range(n):
        whole = n == 1 and len(order) == len(job.points)
        _fit_with_poses(job if whole else job.select(order[bounds[g] : bounds[g + 1]]), fits, g)
    return fits


@njit(cache=True)
def _run(how, inputs, fractions, fits, groups):
    """Fit group after group, ``how``: as the paper, or robustly, or neither."""
    (points, covs, order, bounds, eyes), (status, frames, covariances, counts, chi2) = inputs, fits
    by_paper, robust = how
    sums = np.zeros(N_SUMS)
    for g in groups:
        lo, hi, frame, covariance = bounds[g], bounds[g + 1], frames[g], covariances[g]
        viewpoint, group = eyes[min(g, eyes.shape[0] - 1)], (points, covs, order, lo, hi)
        counts[g] = hi - lo
        if counts[g] < 3:
            status[g] = TOO_FEW
        elif by_paper:
            status[g], chi2[g] = kernels.sp_group(group, viewpoint, frame, covariance)
        else:
            if robust:
                status[g] = robust_group(group, viewpoint, fractions, frame, covariance, sums)
            else:
                status[g] = kernels.ml_group(group, viewpoint, frame, covariance, sums)
            if status[g] == OK:
                counts[g], chi2[g] = int(sums[USED]), sums[CHI2]


def _fit_with_poses(job: FitJob, fits: Fits, g: int) -> None:
    """Fit one group whose scans have pose errors, from a start that does not know of them."""
    if job.robust and job.shared:
        job = job.select(_inliers(job, job.shared))
    n = len(job.points)
    plain = fit_groups(replace(job, shared=None, robust=None), np.arange(n), np.array([0, n]))
    fits.status[g], fits.counts[g] = plain.status[0], n
    if plain.status[0] != OK or job.shared is None:
        return
    if job.method == "sp":
        row, values, frame = np.empty(ROW_SIZE), np.empty(3), np.empty((4, 4))
        start_row((job.points, job.covariances, np.arange(n), 0, n), 2, row)
        row_frame(row, job.viewpoint, frame, values)
        spread = np.array([row[1], values[2] - values[0], values[1] - values[0]])  # W, and lambda less lambda_z
        term = sp_pose_term(job.points, job.covariances, job.shared, plain.frames[0], spread)
        fits.frames[g], fits.covariances[g], fits.chi2[g] = plain.frames[0], plain.covariances[0] + term, plain.chi2[0]
        return
    fitted = fit_shared_pose((job.points, job.covariances), job.viewpoint, job.shared, plain.frames[0])
    fits.status[g], fits.frames[g], fits.covariances[g], fits.chi2[g] = fitted


def _inliers(job: FitJob, shared: SharedPose) -> np.ndarray:
    """Indices of the points that a robust fit keeps, their scans' pose errors folded into their own covariances."""
    n = len(job.points)
    poses = shared.roots_by_scan @ shared.roots_by_scan.transpose(0, 2, 1)
    folded = shared_by_scan(job.points[:, None], poses[shared.scan], shared.origins[shared.scan])
    noise = job.covariances + folded.reshape(-1, 3, 3)
    fits = fit_groups(replace(job, covariances=noise, shared=None), np.arange(n), np.array([0, n]))
    if fits.status[0] != OK:
        return np.arange(0)
    normal, centre = fits.frames[0, :3, 2], fits.frames[0, :3, 3]
    distance, variance = (job.points - centre) @ normal, np.einsum("i,nij,j->n", normal, noise, normal)
    return np.flatnonzero(distance**2 < CUTOFF**2 * variance)
