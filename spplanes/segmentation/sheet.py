"""A grid of points while it is being labelled, and its regions by their moments."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from spplanes._check import FloatArray
from spplanes.fitting._moment_patches import eigenvalues
from spplanes.moments import ROW_SIZE, merge_rows
from spplanes.segmentation.clustering import growing
from spplanes.segmentation.config import MapperConfig


@dataclass(eq=False)
class Sheet:
    """A grid of points while it is being labelled, after the regions that reach into it from earlier scans."""

    points: FloatArray
    covariance: FloatArray
    """All of a point's uncertainty."""
    shared: FloatArray
    """The part of it that a point shares with its scan, shape (S, B, 9), or (1, 1, 1) when there is none."""
    valid: np.ndarray
    """Which points are returns, shape (S, B) bool."""
    labels: np.ndarray
    start: int = 0
    """First row that is to be labelled; those before it are settled and only show where regions reach in."""
    prior: FloatArray = field(default_factory=lambda: np.empty((0, ROW_SIZE)))
    """Moments of the points before `start`, of the regions that reach in, shape (P, 11)."""
    rows: FloatArray = field(default_factory=lambda: np.empty((0, ROW_SIZE)))
    """Moments of the regions, shape (R, 11); region r < P continues the prior one."""
    bias: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    """Variance along the normal that every region shares with its scans, m^2, and its mean scan, shape (R, 2)."""
    alias: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """The region every region has been fused into, or itself, shape (R,)."""

    @property
    def grid(self) -> tuple[FloatArray, FloatArray, np.ndarray, np.ndarray, int]:
        """Points, covariance, valid, labels and start."""
        return self.points, self.covariance, self.valid, self.labels, self.start

    @property
    def fresh(self) -> slice:
        """The rows to be labelled."""
        return slice(self.start, None)

    @property
    def free(self) -> np.ndarray:
        """Returns that belong to no region, in the rows to be labelled, shape (S - start, B) bool."""
        return self.valid[self.fresh] & (self.labels[self.fresh] < 0)


def append(sheet: Sheet, rows: FloatArray, bias: FloatArray) -> None:
    """Add regions to a sheet."""
    first = len(sheet.rows)
    sheet.rows, sheet.bias = np.concatenate((sheet.rows, rows)), np.concatenate((sheet.bias, bias))
    sheet.prior = np.concatenate((sheet.prior, np.zeros((len(rows), ROW_SIZE))))
    sheet.alias = np.concatenate((sheet.alias, np.arange(first, first + len(rows))))


def fuse(sheet: Sheet, root: np.ndarray) -> None:
    """Carry the result of a clustering of the regions over to labels and priors."""
    for r in np.flatnonzero(root != np.arange(len(root))):
        merge_rows(sheet.prior[root[r]], sheet.prior[r], sheet.prior[root[r]])
        sheet.prior[r] = 0.0
    sheet.alias = root[sheet.alias]
    sheet.labels[:] = np.append(root, -1)[sheet.labels]


def refit(sheet: Sheet, config: MapperConfig) -> None:
    """Moments of the regions from all of their points."""
    part = sheet.fresh
    sheet.rows = growing.fit_regions(
        sheet.points[part], sheet.covariance[part], sheet.labels[part], sheet.rows, sheet.prior, config.flatness_m**2
    )


def is_plane(row: FloatArray, config: MapperConfig) -> bool:
    """Whether a region is large enough for a plane, and determines one."""
    return row[0] >= config.min_points and is_determined(row, config)


def is_determined(row: FloatArray, config: MapperConfig) -> bool:
    """Whether the smaller of the two tilts is known to max_tilt_rad."""
    return eigenvalues(row)[1] * config.max_tilt_rad**2 >= 1.0


def drop_small(sheet: Sheet, config: MapperConfig) -> None:
    """Take the points from regions that are too small or do not determine a plane; those from earlier scans stay."""
    keep = np.array([is_plane(row, config) for row in sheet.rows], dtype=bool)
    keep |= sheet.prior[:, 0] > 0.0
    sheet.labels[~np.append(keep, True)[sheet.labels]] = -1


def by_first_point(labels: np.ndarray) -> np.ndarray:
    """Regions in the order of the first point of each, (K,); those without points are left out."""
    regions, first = np.unique(labels, return_index=True)
    order = regions[np.argsort(first)]
    return order[order >= 0]


def renumbered(labels: np.ndarray, kept: np.ndarray | list[int], n_regions: int) -> np.ndarray:
    """Labels as places in `kept`, regions by number; -1 for those that are not kept."""
    number = np.full(n_regions + 1, -1, dtype=np.int64)
    number[kept] = np.arange(len(kept))
    return number[labels]


def means_of(values: FloatArray, labels: np.ndarray, n_regions: int) -> FloatArray:
    """Mean of values (N, 3) of the points of every region, labels (N,), shape (n_regions, 3)."""
    held = labels >= 0
    counts = np.maximum(np.bincount(labels[held], minlength=n_regions), 1)
    sums = [np.bincount(labels[held], values[held, k], minlength=n_regions) for k in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]
