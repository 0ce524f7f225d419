"""What `PlaneMapper` remembers of its regions: moments, noise, shared errors, sides and outlines, but no points."""

from __future__ import annotations

import copy

import numpy as np

from spplanes._check import FloatArray
from spplanes._rows import symmetric3
from spplanes.fitting import _pose_error
from spplanes.fitting._own_noise import unbiased_frame
from spplanes.moments import ROW_SIZE, merge_rows
from spplanes.outlines import outline
from spplanes.outlines._raster import cells_of, distinct, projection_axis
from spplanes.plane import Plane
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.sheet import is_determined, renumbered


class RegionTable:
    """Regions by number, in the order of their first points; a region that joined another one points to it."""

    def __init__(self, config: MapperConfig) -> None:
        self.config = config
        self.n_seen = 0
        self.n_regions = 0
        self._columns = {
            "parent": np.empty(0, dtype=np.int64),
            "axis": np.empty(0, dtype=np.int64),
            "bias": np.empty((0, 2)),
            "test": np.empty((0, ROW_SIZE)),
            "estimate": np.empty((0, ROW_SIZE)),
            "fit": np.empty((0, ROW_SIZE)),
            "noise": np.empty((0, 6)),
            "views": np.empty((0, 3)),
            "anchor": np.empty((0, 3)),
            "pose": np.empty((0, 4, 4)),
            "running": np.empty((0, 6, 4)),
        }
        self.keys, self.n_keys, self._n_distinct = np.empty(1024, dtype=np.int64), 0, 512
        self.kept_labels: list[np.ndarray] = []

    def __getattr__(self, name: str) -> np.ndarray:
        try:
            return self.__dict__["_columns"][name]
        except KeyError as error:
            raise AttributeError(name) from error

    def copy(self) -> RegionTable:
        """A table that may change without this one."""
        other = copy.copy(self)
        other._columns = {name: column.copy() for name, column in self._columns.items()}
        other.keys, other.kept_labels = self.keys.copy(), list(self.kept_labels)
        return other

    @property
    def memory_bytes(self) -> int:
        """Size of everything but kept labels."""
        used = sum(column[: self.n_regions].nbytes for column in self._columns.values())
        return used + 8 * self.n_keys

    def add(self, rows: FloatArray, bias: FloatArray, axes: np.ndarray) -> np.ndarray:
        """Add regions without points yet, known by the estimate (K, 11) of their moments; returns their numbers."""
        first, last = self.n_regions, self.n_regions + len(rows)
        if last > len(self._columns["parent"]):
            self._columns = {name: _enlarged(column, 2 * last) for name, column in self._columns.items()}
        new = np.arange(first, last)
        self.parent[new], self.axis[new], self.bias[new] = new, axes, bias
        self.estimate[new], self.anchor[new] = rows, rows[:, 2:5]
        self.n_regions = last
        return new

    def roots(self, numbers: np.ndarray) -> np.ndarray:
        """The regions that those of the given numbers belong to now."""
        numbers = np.asarray(numbers)
        while True:
            up = self.parent[numbers]
            if np.array_equal(up, numbers):
                return numbers
            numbers = up

    def join(self, into: int, other: int) -> None:
        """Let a region become part of another one."""
        for name in ("test", "fit"):
            rows = self._columns[name]
            merge_rows(rows[into], rows[other], rows[into])
            rows[other] = 0.0
        total, running = _pose_error.merge_sums(
            self.anchor[into], self.anchor[other], self.pose[other], self.running[other]
        )
        self.noise[into] += self.noise[other]
        self.pose[into] += total
        self.running[into] += running
        self.views[into] += self.views[other]
        self.parent[other] = into

    def draw(self, keys: np.ndarray) -> None:
        """Add cells to the outlines, as keys of `_raster`."""
        if self.n_keys + len(keys) > len(self.keys):
            self.keys = _enlarged(self.keys[: self.n_keys], 2 * (self.n_keys + len(keys)))
        self.keys[self.n_keys : self.n_keys + len(keys)] = keys
        self.n_keys += len(keys)
        if self.n_keys > 2 * self._n_distinct:  # cells that repeat go when enough of them may have gathered
            cells = distinct(self.keys[: self.n_keys])
            self.keys[: len(cells)] = cells
            self.n_keys = len(cells)
            self._n_distinct = max(len(cells), 512)

    def kept(self) -> np.ndarray:
        """Numbers of the regions that are planes to report, ascending, shape (K,)."""
        rows = self.fit[: self.n_regions]
        large = np.flatnonzero((self.parent[: self.n_regions] == np.arange(self.n_regions)) & (rows[:, 0] > 0.0))
        large = large[rows[large, 0] >= self.config.min_points]
        return np.array([r for r in large if is_determined(self.test[r], self.config)], dtype=np.int64)

    def labels(self, n_beams: int) -> np.ndarray:
        """Plane of every settled point, shape (S, B), int32."""
        if not self.kept_labels:
            return np.full((0, n_beams), -1, dtype=np.int32)
        of_region = renumbered(self.roots(np.arange(self.n_regions)), self.kept(), self.n_regions)
        return np.append(of_region, -1).astype(np.int32)[np.concatenate(self.kept_labels)]

    def planes(self) -> list[Plane]:
        """The planes to report."""
        kept = self.kept()
        if not len(kept):
            return []
        rows = self.fit[kept]
        eyes = self.views[kept] / rows[:, :1]
        fits = [unbiased_frame(*region) for region in zip(rows, self.noise[kept], eyes, strict=True)]
        frames, spreads, covariances = (np.array(column) for column in zip(*fits, strict=True))
        outlines = self._outlines(kept, frames, spreads, rows)
        result = []
        for k, r in enumerate(kept):
            covariance = covariances[k] + np.diag(self.config.surface_sigma_m**2 * rows[k, 1] / spreads[k])
            covariance += _pose_error.covariance_of(frames[k], spreads[k], self.anchor[r], self.pose[r])
            normal = frames[k][:3, 2]
            chi2 = float(normal @ symmetric3(rows[k, 5:]) @ normal)
            result.append(Plane._trusted(frames[k], covariance, int(rows[k, 0]), outlines[k], chi2))
        return result

    def _outlines(self, kept: np.ndarray, frames: FloatArray, spreads: FloatArray, rows: FloatArray) -> list:
        """Outline of every plane to report."""
        keys = distinct(self.keys[: self.n_keys])
        drawn_for, cells = cells_of(keys)
        owner = self.roots(drawn_for) if len(keys) else drawn_for
        order = np.argsort(owner, kind="stable")
        bounds = np.searchsorted(owner[order], kept), np.searchsorted(owner[order], kept, side="right")
        side = self.config.outline_cell_m
        result = []
        for k in range(len(kept)):
            mine = order[bounds[0][k] : bounds[1][k]]
            axis = projection_axis(*frames[k][:3, 2])
            own = outline.in_projection(cells[mine], self.axis[drawn_for[mine]], axis, side, frames[k])
            polygon = outline.outline_from_cells(own, side, axis, frames[k])
            half = np.sqrt(3.0 * spreads[k, 1:] / rows[k, 1])
            result.append(polygon or outline.outline_from_extent(*half))
        return result


def _enlarged(column: np.ndarray, length: int) -> np.ndarray:
    """The same column with room for more regions, zeros there."""
    larger = np.zeros((length, *column.shape[1:]), dtype=column.dtype)
    larger[: len(column)] = column
    return larger
