"""Planes of a cloud without order: octree cells that are planar fuse into regions, then every point finds its plane."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from spplanes._check import FloatArray
from spplanes._jit import njit
from spplanes.clouds._octree_kernels import LOCAL
from spplanes.clouds.octree import Cells, Curve
from spplanes.fitting.shared_error import shared_error_of
from spplanes.moments import ROW_SIZE
from spplanes.segmentation.clustering.growing import fit_regions, hesse
from spplanes.segmentation.clustering.joining import cluster_patches
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.planes import frames_of
from spplanes.segmentation.sheet import is_determined, is_plane, renumbered


def label_curve(curve: Curve, variances: FloatArray, octave_m: float, config: MapperConfig) -> np.ndarray:
    """The plane of every point of a curve, shape (N,), -1 = none, by their variances (N,), m^2. What surfaces wander
    from planes by is found with them: the search starts again, once, with the points that fit no plane and with the
    shared error that planes have shown, `octave_m` at least (see `spplanes.fitting.shared_error`)."""
    state: _Labelling | None = None
    for _ in range(2):
        free = np.ones(len(variances), dtype=bool) if state is None else state.labels < 0
        if not free.any():
            break
        cells = Cells.of(curve.points[free], curve.keys[free], variances[free], octave_m**2, config.max_tilt_rad)
        state = state or _Labelling(curve.points, variances, cells, config)
        state.octave_m = octave_m
        state.add_regions(cells, free)
        state.spread()
        octave_m = max(octave_m, state.shown_octave_m())
    return np.full(len(variances), -1) if state is None else state.labels


@dataclass(eq=False)
class _Labelling:
    """A cloud along its curve, points (N, 3) with variances (N,), while it is being labelled."""

    points: FloatArray
    variances: FloatArray
    cells: Cells
    """Of all points: where planes meet, and where they grow."""
    config: MapperConfig
    octave_m: float = 0.0
    """Standard deviation of an octave of the shared error, m."""
    rows: FloatArray = field(default_factory=lambda: np.empty((0, ROW_SIZE)))

    def __post_init__(self) -> None:
        n_cells = len(self.cells.level)
        pairs = self.cells.neighbours
        itself = np.repeat(np.arange(n_cells)[:, None], 2, axis=1)
        both = np.concatenate((pairs, pairs[:, ::-1], itself))
        ones = np.ones(len(both), np.int32)
        self._touch: Any = csr_matrix((ones, (both[:, 0], both[:, 1])), shape=(n_cells, n_cells))
        self._cell = self.cells.of_points
        self.labels = np.full(len(self.points), -1)

    def add_regions(self, cells: Cells, free: np.ndarray) -> None:
        """Planar cells of free points (N,), bool, that are one plane with those they touch become regions."""
        number = np.cumsum(cells.planar) - 1
        pairs, rows = cells.neighbours, cells.rows[cells.planar]
        edges = number[pairs[cells.planar[pairs].all(axis=1)]]
        root = cluster_patches(rows, np.zeros((len(rows), 2)), edges, self.config, self.octave_m)
        few = self.config.min_points / 2
        kept = [r for r in np.unique(root) if rows[r, 0] >= few and is_determined(rows[r], self.config)]
        label = np.full(len(rows), -1)
        label[kept] = len(self.rows) + np.arange(len(kept))
        of_cell = np.full(len(cells.level), -1)
        of_cell[cells.planar] = label[root]
        self.labels[free] = of_cell[cells.of_points]
        self.rows = np.concatenate((self.rows, rows[kept]))

    def spread(self) -> None:
        """Every point finds its plane, planes are fitted again, and fuse where they are one; until they rest. They grow
        by a cell a step, and rest when fewer than one in a thousand points change their plane."""
        for _ in range(12):
            if not len(self.rows):
                return
            changed = self._assign()
            self._refit()
            if self._fuse_and_dissolve():
                self._refit()
            elif changed <= 1e-3 * len(self.points):
                break
        self._keep([r for r, row in enumerate(self.rows) if is_plane(row, self.config)])

    def shown_octave_m(self) -> float:
        """Standard deviation of an octave of the error that neighbours share, as the regions show it, m."""
        if not len(self.rows):
            return 0.0
        frames, spreads = frames_of(self.rows, np.full((len(self.rows), 3), np.nan))
        covariances = np.zeros((len(frames), 3, 3))
        covariances[:, (0, 1, 2), (0, 1, 2)] = 1.0 / spreads
        cloud = self.points, self.variances[:, None], self.labels
        return shared_error_of(*cloud, frames, covariances, stated=False).octave_sigma_m

    def _wander(self) -> FloatArray:
        """Variance of the points of every region about its plane beside their noise, shape (R,), m^2."""
        octaves = 0.5 * np.log2(np.maximum(self.rows[:, 0], 1.0) / LOCAL)
        return self.octave_m**2 * np.maximum(octaves, 1.0)

    def _in_cells(self) -> Any:  # scipy's sparse matrices have no useful types
        """How many points every region has in every cell, shape (C, R)."""
        new = np.flatnonzero((np.diff(self.labels, prepend=-2) != 0) | (np.diff(self._cell, prepend=-1) != 0))
        new = new[self.labels[new] >= 0]
        shape = len(self.cells.level), len(self.rows)
        return csr_matrix((np.ones(len(new), np.int32), (self._cell[new], self.labels[new])), shape=shape)

    def _assign(self) -> int:
        """Points go to the plane that they fit best of those in their cell and beside it; how many changed."""
        near = self._touch @ self._in_cells()
        near.sort_indices()
        gate, planes = self.config.gate_sigma**2, hesse(self.rows)
        cells = self.cells.bounds, near.indptr, near.indices
        return _assign_points((self.points, self.variances), cells, planes, self._wander(), gate, self.labels)

    def _refit(self) -> None:
        """Moments of the regions from all of their points; those without any go."""
        self._keep(np.unique(self.labels[self.labels >= 0]))
        grid = self.points[None], self.variances[None, :, None], self.labels[None]
        self.rows = fit_regions(*grid, self.rows, np.zeros_like(self.rows), 0.0)

    def _keep(self, kept: np.ndarray | list[int]) -> None:
        """Keep some regions, in the order given; the points of others are free."""
        self.labels, self.rows = renumbered(self.labels, kept, len(self.rows)), self.rows[kept]

    def _fuse_and_dissolve(self) -> bool:
        """Regions that meet and are one plane become one, superfluous ones none; whether there were any."""
        own = self._in_cells()
        meeting = (own.T @ (self._touch @ own)).tocoo()
        edges = np.stack((meeting.row, meeting.col), axis=1)[meeting.row < meeting.col].astype(np.int64)
        if not len(edges):
            return False
        edges = edges[np.lexsort(edges.T[::-1])]
        root = cluster_patches(self.rows, np.zeros((len(self.rows), 2)), edges, self.config, self.octave_m)
        self.labels = np.append(root, -1)[self.labels]
        dissolved = self._dissolve(root[edges])
        return dissolved or bool((root != np.arange(len(root))).any())

    def _dissolve(self, edges: np.ndarray) -> bool:
        """Regions of whose points larger ones beside them explain 70 % give them up; whether there were any."""
        planes, wander = hesse(self.rows), self._wander()
        sizes = np.bincount(self.labels[self.labels >= 0], minlength=len(self.rows))
        order = np.argsort(self.labels, kind="stable")
        first = np.searchsorted(self.labels[order], np.arange(len(self.rows) + 1))
        swap = sizes[edges[:, 0]] > sizes[edges[:, 1]]
        small, large = np.where(swap[:, None], edges[:, ::-1], edges).T
        gone = np.zeros(len(self.rows), dtype=bool)
        for r in sorted(np.unique(small), key=lambda r: (sizes[r], r)):
            mine, hosts = order[first[r] : first[r + 1]], np.unique(large[(small == r) & (large != r)])
            hosts = hosts[~gone[hosts]]
            if len(mine) and len(hosts):
                off = self.points[mine] @ planes[hosts, :3].T - planes[hosts, 3]
                near = off**2 <= self.config.gate_sigma**2 * (self.variances[mine][:, None] + wander[hosts])
                gone[r] = near.any(axis=1).mean() > 0.7
        self.labels[np.append(gone, False)[self.labels]] = -1
        return bool(gone.any())


@njit(cache=True)
def _assign_points(cloud, cells, planes, tolerance, gate, labels):
    """Give every point the plane of its cell's candidates that it fits best, to chi2 of `gate`, in place; how many
    changed.

    `cells` are the bounds (C + 1,) of the runs of points that are cells, first and candidates: the planes of cell c are
    candidates[first[c]:first[c + 1]]. `tolerance` (R,), m^2, is granted to surfaces beside the noise of their points.
    """
    (points, variances), (bounds, first, candidates) = cloud, cells
    changed = 0
    for c in range(bounds.shape[0] - 1):
        if first[c] == first[c + 1]:
            continue
        for k in range(bounds[c], bounds[c + 1]):
            best, label = gate, -1
            for m in range(first[c], first[c + 1]):
                r = candidates[m]
                off = points[k, 0] * planes[r, 0] + points[k, 1] * planes[r, 1] + points[k, 2] * planes[r, 2]
                off -= planes[r, 3]
                chi2 = off * off / (variances[k] + tolerance[r])
                if chi2 <= best:
                    best, label = chi2, r
            changed += label != labels[k]
            labels[k] = label
    return changed
