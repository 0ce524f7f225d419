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
        self._columns: dict[str, np.ndarray] = {
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
        self.keys, self._n_distinct = [np.empty(0, dtype=np.int64)], 512
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
        other.keys, other.kept_labels = list(self.keys), list(self.kept_labels)
        return other

    @property
    def memory_bytes(self) -> int:
        """Size of everything but kept labels."""
        return sum(array.nbytes for array in (*self._columns.values(), *self.keys))

    def add(self, rows: FloatArray, bias: FloatArray, axes: np.ndarray) -> np.ndarray:
        """Add regions without points yet, known by the estimate (K, 11) of their moments; returns their numbers."""
        new = len(self.parent) + np.arange(len(rows))
        known = {"parent": new, "axis": axes, "bias": bias, "estimate": rows, "anchor": rows[:, 2:5]}
        for name, column in self._columns.items():
            more = known.get(name, np.zeros((len(rows), *column.shape[1:])))
            self._columns[name] = np.concatenate((column, more))
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
        self.keys.append(keys)
        if sum(map(len, self.keys)) > 2 * self._n_distinct:  # cells that repeat go when enough may have gathered
            self.keys = [distinct(np.concatenate(self.keys))]
            self._n_distinct = max(len(self.keys[0]), 512)

    def kept(self) -> np.ndarray:
        """Numbers of the regions that are planes to report, ascending, shape (K,)."""
        counts, is_root = self.fit[:, 0], self.parent == np.arange(len(self.parent))
        large = np.flatnonzero(is_root & (counts > 0.0) & (counts >= self.config.min_points))
        return np.array([r for r in large if is_determined(self.test[r], self.config)], dtype=np.int64)

    def labels(self, n_beams: int) -> np.ndarray:
        """Plane of every settled point, shape (S, B), int32."""
        if not self.kept_labels:
            return np.full((0, n_beams), -1, dtype=np.int32)
        n_regions = len(self.parent)
        of_region = renumbered(self.roots(np.arange(n_regions)), self.kept(), n_regions)
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
        drawn_for, cells = cells_of(distinct(np.concatenate(self.keys)))
        owner = self.roots(drawn_for)
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
