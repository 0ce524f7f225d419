"""The input of a plane fit, checked once, and its division into groups."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_positive, as_shape
from spplanes._jit import njit
from spplanes._rows import NO_VIEWPOINT
from spplanes.fitting._point_checks import LARGEST_VARIANCE, SMALLEST_VARIANCE, as_covariances, as_points
from spplanes.fitting._shared_pose import SharedPose

Method = Literal["ml", "sp"]
Robust = Literal["tukey"]
METHODS: tuple[Method, ...] = ("ml", "sp")
ROBUST: tuple[Robust | None, ...] = (None, "tukey")


@dataclass(frozen=True, eq=False)
class FitJob:
    """Checked input of a fit."""

    points: FloatArray
    """Shape (N, 3), m."""
    covariances: FloatArray
    """Shape (N, 3, 3), or (1, 3, 3) when all points share one, m^2."""
    step: int
    """Distance between the covariances of successive points: 0 when they share one."""
    viewpoint: FloatArray
    """Shape (3,), m; NaN for none."""
    method: Method
    """How to fit."""
    robust: Robust | None
    """What to do about outliers."""
    shared: SharedPose | None
    """The pose errors that points of one scan share."""

    @classmethod
    def checked(
        cls,
        points: ArrayLike,
        covariances: ArrayLike | None,
        *,
        sigma: float | None,
        method: Method,
        viewpoint: ArrayLike | None,
        robust: Robust | None,
        scan_index: ArrayLike | None,
        pose_covariances: ArrayLike | None,
        scan_origins: ArrayLike | None,
    ) -> FitJob:
        """Check what the caller gave."""
        if method not in METHODS:
            raise ValueError(f"method: expected one of {METHODS}, got {method!r}")
        if robust not in ROBUST:
            raise ValueError(f"robust: expected one of {ROBUST}, got {robust!r}")
        if robust and method == "sp":
            raise ValueError("robust: expected None with method 'sp', got " + repr(robust))
        array = as_points("points", points)
        noise, step = _covariances(covariances, sigma, len(array))
        eye = NO_VIEWPOINT if viewpoint is None else as_shape("viewpoint", viewpoint, (3,))
        shared = SharedPose.checked(array, scan_index, pose_covariances, scan_origins)
        return cls(array, noise, step, eye, method, robust, shared)

    def select(self, chosen: np.ndarray) -> FitJob:
        """The same for a subset of the points."""
        noise = self.covariances[chosen] if self.step else self.covariances
        shared = self.shared.select(chosen) if self.shared else None
        return FitJob(self.points[chosen], noise, self.step, self.viewpoint, self.method, self.robust, shared)


def _covariances(covariances: ArrayLike | None, sigma: float | None, n: int) -> tuple[FloatArray, int]:
    """Covariances and the step between those of successive points."""
    if covariances is not None and sigma is None:
        return as_covariances("covariances", covariances, n), 1
    if sigma is not None and covariances is None:
        deviation = as_positive("sigma", sigma)
        if not SMALLEST_VARIANCE**0.5 <= deviation <= LARGEST_VARIANCE**0.5:
            raise ValueError(
                f"sigma: expected {SMALLEST_VARIANCE**0.5:.0e} to {LARGEST_VARIANCE**0.5:.0e} m, got {deviation}"
            )
        return deviation**2 * np.eye(3)[None], 0
    raise ValueError("covariances: expected either them or sigma, got " + ("neither" if sigma is None else "both"))


def group_by_label(labels: ArrayLike | None, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distinct labels >= 0 ascending (P,), indices sorted by label, stable, and the groups' bounds (P + 1,)."""
    array = np.asarray(labels)
    if array.size == 0:
        array = array.astype(np.int64)
    if array.shape != (n,) or array.dtype.kind not in "iu":
        raise ValueError(f"labels: expected {n} integers, one for each point, got {array.dtype} of shape {array.shape}")
    if n and array.max() < n:
        return _count_labels(array.astype(np.int64, copy=False), int(array.max()))
    order = np.argsort(array, kind="stable")
    ranked = array[order]
    first = int(np.searchsorted(ranked, 0))
    starts = first + np.flatnonzero(np.diff(ranked[first:], prepend=-1))
    return ranked[starts], order[first:], np.append(starts, n) - first


def _count_labels(labels, largest: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same by counting, for labels that are not far apart: no comparison, one walk over the points."""
    counts = np.bincount(labels[labels >= 0], minlength=largest + 1)
    ends = np.concatenate(([0], np.cumsum(counts)))
    names, order = np.flatnonzero(counts), np.empty(ends[-1], np.int64)
    bounds = np.append(ends[names], ends[-1])
    _put_in_place(labels, ends, order)
    return names, order, bounds


@njit(cache=True)
def _put_in_place(labels, ends, order) -> None:
    """Write the points of one label after the other to `order`; `ends`, where each begins, are moved to its end."""
    for i in range(labels.shape[0]):
        if labels[i] >= 0:
            order[ends[labels[i]]] = i
            ends[labels[i]] += 1
