"""The scans that `PlaneMapper` has not settled yet, and the settling of them."""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_covariance, as_shape
from spplanes.fitting import _pose_error
from spplanes.fitting._own_noise import add_noise
from spplanes.fitting._pose_error import shared_by_scan
from spplanes.mapping._region_table import RegionTable
from spplanes.moments import ROW_SIZE, merge_rows
from spplanes.outlines._raster import along_axes, draw, keys_of, projection_axis
from spplanes.segmentation.clustering.growing import fit_regions, hesse
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.pipeline import segment_sheet
from spplanes.segmentation.planes import shares_of
from spplanes.segmentation.refinement.refining import BORDER_GAP
from spplanes.segmentation.scans import as_grid, as_noise
from spplanes.segmentation.sheet import Sheet, by_first_point, renumbered

#: Settled scans kept to show where regions reach in: as far as an occluder may part a plane.
CONTEXT_SCANS = BORDER_GAP + 1


class Strip:
    """A buffer of scans: first the context, settled and labelled by region number, then the open ones."""

    def __init__(self, n_beams: int, config: MapperConfig) -> None:
        self.n_beams = n_beams
        self.n_context, self.n_open_rows = 0, 0
        length = CONTEXT_SCANS + config.strip_scans + config.lookahead_scans
        self.points = np.zeros((length, n_beams, 3))
        self.covariance = np.zeros((length, n_beams, 9))
        self.valid = np.zeros((length, n_beams), dtype=bool)
        self.labels = np.full((length, n_beams), -1, dtype=np.int64)
        self.views = np.full((length, 3), np.nan)
        self.pose_covariances = np.zeros((length, 6, 6))
        self.origins = np.zeros((length, 3))

    @property
    def is_full(self) -> bool:
        """Whether there are as many open scans as are settled at a time, and those to look ahead."""
        return self.n_open_rows == len(self.points) - CONTEXT_SCANS

    @property
    def n_open(self) -> int:
        """Number of returns in the open scans."""
        return int(self.valid[self.n_context : self.n_context + self.n_open_rows].sum())

    @property
    def memory_bytes(self) -> int:
        """Size of the buffer."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))

    def copy(self) -> Strip:
        """A strip that may be settled without this one; scans are not changed by that, so they are not copied."""
        other = copy.copy(self)
        other.labels = self.labels.copy()
        return other

    def append(
        self,
        scan: FloatArray,
        covariances: ArrayLike,
        viewpoint: ArrayLike | None,
        pose_covariance: ArrayLike | None,
        scan_origin: ArrayLike | None,
    ) -> None:
        """Check a scan, points of shape (B, 3), and put it behind the others."""
        k = self.n_context + self.n_open_rows
        (scan,), (valid,) = as_grid(scan[None])
        matrices = as_noise("covariances", covariances, valid)
        if k and (viewpoint is None) != np.isnan(self.views[k - 1, 0]):
            got = f"got {'none' if viewpoint is None else 'one'} unlike the scan before"
            raise ValueError(f"viewpoint: expected one with every scan or with none, {got}")
        shared = 0.0 if pose_covariance is None else as_covariance("pose_covariance", pose_covariance, 6)
        self.pose_covariances[k] = shared
        self.views[k] = np.nan if viewpoint is None else as_shape("viewpoint", viewpoint, (3,))
        self.origins[k] = 0.0 if scan_origin is None else as_shape("scan_origin", scan_origin, (3,))
        self.points[k] = scan
        self.covariance[k], self.valid[k], self.labels[k] = matrices.reshape(-1, 9), valid, -1
        self.n_open_rows += 1

    def sheet(self, table: RegionTable) -> tuple[Sheet, np.ndarray]:
        """The context and the open scans as a sheet, and the numbers of the regions that reach in, (P,)."""
        used = slice(0, self.n_context + self.n_open_rows)
        labels = self.labels[used].copy()
        known = labels[: self.n_context]
        known[known >= 0] = table.roots(known[known >= 0])
        active = np.unique(known[known >= 0])
        known[known >= 0] = np.searchsorted(active, known[known >= 0])
        total, shared = self.covariance[used], np.zeros((1, 1, 1))
        if self.pose_covariances[used].any():
            shared = shared_by_scan(self.points[used], self.pose_covariances[used], self.origins[used])
            total = total + shared
        sheet = Sheet(
            self.points[used],
            total,
            shared,
            self.valid[used],
            labels,
            start=self.n_context,
            prior=table.test[active],
            rows=table.estimate[active],
            bias=table.bias[active],
            alias=np.arange(len(active)),
        )
        return sheet, active

    def advance(self, n_settled: int) -> None:
        """Keep the last settled scans as context and move the open ones up behind them."""
        end = self.n_context + n_settled
        first = max(end - CONTEXT_SCANS, 0)
        stop = self.n_context + self.n_open_rows
        for name in ("points", "covariance", "valid", "labels", "views", "pose_covariances", "origins"):
            column = getattr(self, name)
            column[: stop - first] = column[first:stop].copy()
        self.n_context, self.n_open_rows = end - first, self.n_open_rows - n_settled


def settle(strip: Strip, table: RegionTable, n_scans: int, config: MapperConfig) -> None:
    """Segment a strip and enter its first open scans into the table; `Strip.advance` then moves on."""
    sheet, active = strip.sheet(table)
    eyes = np.where(np.isnan(strip.views), 0.0, strip.views)[: len(sheet.points)]
    segment_sheet(sheet, eyes, config)
    part = slice(strip.n_context, strip.n_context + n_scans)
    number = _numbers(sheet, active, part, table)
    _enter(strip, sheet, number, part, table, config)
    labels = np.append(number, -1)[sheet.labels[part]]
    strip.labels[part] = labels
    drawn = slice(max(part.start - 1, 0), part.stop)
    projections = along_axes(table.axis[: table.n_regions], config.outline_cell_m)
    table.draw(keys_of(*draw(strip.points[drawn], strip.labels[drawn], projections)))
    table.n_seen += int(strip.valid[part].sum())
    if config.keep_labels:
        table.kept_labels.append(labels.astype(np.int32))


def _numbers(sheet: Sheet, active: np.ndarray, part: slice, table: RegionTable) -> np.ndarray:
    """Region number of every region of a sheet, shape (R,): known ones join where the sheet fused them."""
    number = np.full(len(sheet.rows), -1, dtype=np.int64)
    for p, old in enumerate(active):
        root = sheet.alias[p]
        if number[root] < 0:
            number[root] = old
        elif number[root] != old:
            table.join(int(number[root]), int(old))
    order = by_first_point(sheet.labels[part])
    fresh = order[number[order] < 0]
    planes = hesse(sheet.rows)
    axes = np.array([projection_axis(*planes[r, :3]) for r in fresh], dtype=np.int64)
    number[fresh] = table.add(sheet.rows[fresh], sheet.bias[fresh], axes)
    return number


def _enter(
    strip: Strip, sheet: Sheet, number: np.ndarray, part: slice, table: RegionTable, config: MapperConfig
) -> None:
    """Add the points of settled scans to the moments and shared errors of their regions."""
    labels, none = sheet.labels[part], np.zeros((len(sheet.rows), ROW_SIZE))
    points, own = sheet.points[part], strip.covariance[part]
    test = fit_regions(points, sheet.covariance[part], labels, sheet.rows, none, config.flatness_m**2)
    fit = fit_regions(points, own, labels, sheet.rows, none, 0.0)
    noise = np.zeros((len(sheet.rows), 6))
    add_noise(own, labels, hesse(sheet.rows), noise)
    shares = shares_of(labels, len(sheet.rows)).astype(np.float64)
    for r in np.flatnonzero(number >= 0):
        g = number[r]
        table.estimate[g], table.bias[g] = sheet.rows[r], sheet.bias[r]
        if shares[:, r].any():
            merge_rows(table.test[g], test[r], table.test[g])
            merge_rows(table.fit[g], fit[r], table.fit[g])
            table.noise[g] += noise[r]
            table.views[g] += shares[:, r] @ strip.views[part]
    if strip.pose_covariances[part].any():
        _enter_pose_errors(strip, sheet, number, part, table, config)


def _enter_pose_errors(strip, sheet, number, part, table, config) -> None:
    """Add the shared errors of settled scans to the sums of their regions."""
    here = np.flatnonzero(number >= 0)
    g = number[here]
    total, running = table.pose[g], table.running[g]
    grid = sheet.points[part], strip.covariance[part], renumbered(sheet.labels[part], here, len(number))
    errors = _pose_error.roots(strip.pose_covariances[part]), strip.origins[part], config.pose_decay
    _pose_error.accumulate(grid, (hesse(sheet.rows)[here], table.anchor[g]), errors, total, running)
    table.pose[g], table.running[g] = total, running
