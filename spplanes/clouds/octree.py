"""Octree of a cloud without order: points along a Morton curve, cells that are planar, neighbours of cells.

The curve makes the order of a cloud its own: whatever order the points come in, they leave in the same. The points of a
cell follow each other on it, so that a cell is a run of points and needs no list.

References:
    Morton, "A computer oriented geodetic data base and a new technique in file sequencing", IBM 1966.
    Meagher, "Geometric modeling using octree encoding", Computer Graphics and Image Processing 1982.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.optimize import isotonic_regression
from scipy.special import chdtri, ndtri

from spplanes._check import FloatArray
from spplanes.clouds._octree_kernels import LEVELS, LOCAL, largest_cells, local_scatter, planar_leaves
from spplanes.fitting.shared_error import weighted_median
from spplanes.outlines._raster import distinct_pairs

#: Noise is found in so many bins of range at most, each of so many cells at least.
_BINS, _CELLS_OF_BIN = 12, 20
#: Numbers of 10 bits with two zeros before every bit, and of 15 bits every third.
_SPREAD = np.bitwise_or.reduce([(np.arange(1 << 10) >> bit & 1) << 3 * bit for bit in range(10)])
_GATHERED = np.bitwise_or.reduce([(np.arange(1 << 15) >> 3 * bit & 1) << bit for bit in range(5)])


@dataclass(frozen=True, eq=False)
class Curve:
    """The distinct points of a cloud along a Morton curve."""

    points: FloatArray
    """Shape (N, 3), m, no two the same."""
    keys: np.ndarray
    """Their places on the curve, ascending, shape (N,), int64."""
    number: np.ndarray
    """Which of them each point of the cloud is, shape (M,), int64."""

    @classmethod
    def through(cls, cloud: FloatArray) -> Curve:
        """Through the points of a cloud (M, 3), all finite, at least one."""
        corner, side = cloud.min(axis=0), max(float(np.ptp(cloud, axis=0).max()), 1e-9)
        keys = _interleaved(np.minimum((cloud - corner) / side * (1 << LEVELS), (1 << LEVELS) - 1).astype(np.int64))
        order = np.argsort(keys, kind="stable")
        tied = np.diff(keys[order]) == 0
        if (tied & (np.diff(cloud[order], axis=0) != 0.0).any(axis=1)).any():  # the same place, not the same point
            order = np.lexsort((cloud[:, 2], cloud[:, 1], cloud[:, 0], keys))
        sorted_points, sorted_keys = cloud[order] + 0.0, keys[order]
        first = (np.diff(sorted_points, axis=0, prepend=np.nan) != 0.0).any(axis=1)
        number = np.empty(len(order), dtype=np.int64)
        number[order] = np.cumsum(first) - 1
        return cls(sorted_points[first], sorted_keys[first], number)

    def noise_law(self, ranges: FloatArray) -> tuple[FloatArray, FloatArray] | None:
        """Variance of points about planes through their neighbours, m^2, by range (N,), m: some ranges, ascending, and
        the variances at these, (K,) both; None where too few look flat.

        It is the median over flat cells at about the same range, and never falls with it: noise of range sensors grows.
        Cells are taken larger, four times as many points, until enough at that range look flat: where points lie closer
        than they err, small cells are balls.
        """
        cells = self._flat_cells(ranges)
        if not len(cells):
            return None
        cells = cells[np.argsort(ranges[cells[:, 3].astype(np.int64)], kind="stable")]
        bins = np.array_split(cells, max(min(len(cells) // _CELLS_OF_BIN, _BINS), 1))
        medians = np.array([_median_variance(one) for one in bins])
        middles = np.array([np.median(ranges[one[:, 3].astype(np.int64)]) for one in bins])
        rising = isotonic_regression(medians, weights=[one[:, 0].sum() for one in bins]).x
        return middles, rising

    def _flat_cells(self, ranges: FloatArray) -> FloatArray:
        """Cells that look flat (see `local_scatter`), in every shell of ranges the smallest of which there are enough.

        Flat are cells whose smallest extent is less than a tenth of the middle one, enough are three in ten points, and
        of larger cells two, or it may be chance. Noise grows with the range: cells that show that of near points are
        balls of far ones. Shells that have too few are put together until they may have enough of the next size. In a
        ball of half the size it has at least a quarter of its variance, and of that, where a side of the cell cuts it,
        the share of a normal distribution that is cut in the middle, or it was no ball but a corner, in which one of
        ten cells is not.
        """
        n_shells = max(min(len(ranges) // (_CELLS_OF_BIN * LOCAL), _BINS), 1)
        shell = np.searchsorted(np.quantile(ranges, np.arange(1, n_shells) / n_shells), ranges)
        sizes = np.bincount(shell, minlength=n_shells)
        found = [np.empty((0, 4))] * n_shells  # of shells that were put together with the first
        held, most, missing = np.zeros(n_shells), np.full(n_shells, np.inf), np.ones(n_shells, dtype=bool)
        fewest = LOCAL
        while fewest <= max(len(self.points), LOCAL) and missing.any():
            cells = largest_cells(self.keys, 4 * fewest - 1)
            judged = local_scatter(self.points, cells[np.diff(cells)[:, 0] >= fewest])
            place = shell[judged[:, 3].astype(np.int64)]
            for group in _together(missing, sizes, _CELLS_OF_BIN * fewest):
                mine, size = judged[np.isin(place, group)], sizes[group]
                flat = mine[mine[:, 1] < 0.1 * mine[:, 2]]
                if len(flat) < 2 and fewest > LOCAL:
                    continue
                points = flat[:, 0].sum()
                if points > held[group].sum() and _median_variance(flat) <= most[group].max():
                    held[group] = points * size / size.sum()
                    missing[group] = points <= 0.3 * size.sum()
                    for s in group:
                        found[s] = flat[:0]
                    found[group[0]] = flat
                flattest = mine[np.argsort(mine[:, 1], kind="stable")][: len(mine) // 10 + 1]
                if len(mine):
                    most[group] = 4.0 / (1.0 - 2.0 / np.pi) * _median_variance(flattest)
            fewest *= 4
        return np.concatenate(found)

    def number_of_first(self) -> np.ndarray:
        """Which point of the cloud, the first of its copies, each point is, shape (N,), int64."""
        first = np.zeros(len(self.points), dtype=np.int64)
        first[self.number[::-1]] = np.arange(len(self.number))[::-1]
        return first

    def neighbourhoods(self) -> np.ndarray:
        """A number for every point, the same for up to 2 LOCAL neighbours, shape (N,)."""
        cells = largest_cells(self.keys, 2 * LOCAL)
        order = np.argsort(cells[:, 0])
        return np.repeat(order, np.diff(cells)[order, 0])


@dataclass(frozen=True, eq=False)
class Cells:
    """The leaves of an octree, along the curve."""

    bounds: np.ndarray
    """First point of each, and where the last one ends, shape (C + 1,)."""
    level: np.ndarray
    """Times that the cube was halved, shape (C,)."""
    place: np.ndarray
    """Key of the corner nearest the origin, shape (C,)."""
    planar: np.ndarray
    """Whether all points fit one plane that they determine, shape (C,) bool."""
    rows: FloatArray
    """Moments, weighted by inverse variances, shape (C, 11)."""

    @classmethod
    def of(
        cls, points: FloatArray, keys: np.ndarray, variances: FloatArray, octave: float, max_tilt_rad: float
    ) -> Cells:
        """Leaves of points (N, 3) along a curve with variances (N,), m^2: the largest cells that are planar. A cell, of
        six points at least, is planar when its residuals are those of the noise, or 15 % more, when no octant of it
        lies off its plane, and when its points determine the plane's tilt to ``max_tilt_rad``."""
        limits = np.array([-ndtri(1e-3), 1.15, chdtri(1, 1e-4), max_tilt_rad**-2.0])
        found, rows = planar_leaves(points, keys, variances, octave, 6, limits)
        bounds = np.append(found[:, 0], len(points))
        shift = 3 * (LEVELS - found[:, 1])
        return cls(bounds, found[:, 1], keys[found[:, 0]] >> shift << shift, found[:, 2] > 0, rows)

    @property
    def of_points(self) -> np.ndarray:
        """The cell of every point, shape (N,)."""
        return np.repeat(np.arange(len(self.level)), np.diff(self.bounds))

    @cached_property
    def neighbours(self) -> np.ndarray:
        """Pairs of cells that touch, at a face, an edge or a corner, each once, shape (E, 2)."""
        shift = LEVELS - self.level
        parts = (self.place[:, None] >> np.arange(3) + bit & 0x7FFF for bit in (0, 15, 30, 45))
        corner = np.bitwise_or.reduce([_GATHERED[part] << 5 * k for k, part in enumerate(parts)]) >> shift[:, None]
        beside = corner[:, None, :] + np.array([step for step in product((-1, 0, 1), repeat=3) if any(step)])
        inside = ((beside >= 0) & (beside < (1 << self.level)[:, None, None])).all(axis=2)
        cell, which = np.nonzero(inside)
        keys = _interleaved(beside[cell, which]) << 3 * shift[cell]
        other = np.searchsorted(self.place, keys, side="right") - 1
        larger = 3 * (LEVELS - self.level[other])
        holds = (other >= 0) & (keys >> larger == self.place[other] >> larger) & (self.level[other] <= self.level[cell])
        pairs = np.sort(np.stack((cell[holds], other[holds]), axis=1), axis=1)
        return distinct_pairs(pairs, len(self.level))


def _together(missing: np.ndarray, sizes: np.ndarray, enough: int) -> list[np.ndarray]:
    """Numbers of the shells (S,) that are missing, neighbours together until they have enough points."""
    groups: list[list[int]] = []
    for s in np.flatnonzero(missing).tolist():
        if groups and groups[-1][-1] == s - 1 and sizes[groups[-1]].sum() < enough:
            groups[-1].append(s)
        else:
            groups.append([s])
    return [np.array(one) for one in groups]


def _median_variance(cells: FloatArray) -> float:
    """Variance of the noise that most points show, m^2, by the scatter of cells (n, sum of squares, ...)."""
    dof = cells[:, 0] - 3.0
    return weighted_median(cells[:, 1] / chdtri(dof, 0.5), cells[:, 0])  # half of chi2 lies below its median


def _interleaved(places: np.ndarray) -> np.ndarray:
    """Keys of places (..., 3) of up to 20 bits: their bits in turn, shape (...,), int64."""
    x, y, z = np.moveaxis(_SPREAD[places & 1023] | _SPREAD[places >> 10] << 30, -1, 0)
    return x | y << 1 | z << 2
