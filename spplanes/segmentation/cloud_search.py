"""The search for planes in one cloud: along the rows and columns of a grid, or of points without order."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from spplanes._check import TOO_LARGE, FloatArray, as_positive
from spplanes.clouds.arrange import are_linked, turn_of
from spplanes.clouds.octree import Curve
from spplanes.clouds.scatter import scatter_along_beams
from spplanes.outlines.outline import outlines_of_groups
from spplanes.plane import Plane
from spplanes.segmentation.clustering.growing import hesse
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.planes import FittedPlanes, cells_of, fit_labelled, moments_of, or_rectangles, outlines_in
from spplanes.segmentation.scans import label_scans
from spplanes.segmentation.sheet import means_of, renumbered
from spplanes.segmentation.unordered import label_curve

#: Variances of points, m^2, by their ranges, m.
Law = Callable[[FloatArray], FloatArray]


class Found(NamedTuple):
    """What a search finds: labels of the returns, and planes about an origin, (3,), m."""

    labels: np.ndarray
    planes: list[Plane]
    origin: FloatArray
    fitted: FittedPlanes
    variances: FloatArray
    """That the distinct points were fitted with, m^2."""
    by_eye: np.ndarray
    """Whose side the eyes tell, shape (R,), bool."""


class CloudSearch:
    """A cloud that is searched for planes: points (N, 3) or (S, B, 3), m; the returns `seen` among them, (N,) or
    (S, B); and where they were seen from, `eyes`, of the points' shape."""

    def __init__(self, points: FloatArray, eyes: FloatArray, sigma: float | None, config: MapperConfig) -> None:
        """From one eye (3,), or from one for each point (N, 3)."""
        seen = np.asarray(np.isfinite(points).all(axis=-1))
        largest = float(np.abs(points[seen]).max(initial=0.0))
        if largest >= TOO_LARGE:
            raise ValueError(f"cloud: expected numbers below {TOO_LARGE:g}, got {largest:.3g}")
        seen &= (np.abs(points - eyes) > 1.0 / TOO_LARGE).any(axis=-1)  # at the viewpoint itself there is no direction
        if np.count_nonzero(seen) < 3:
            raise ValueError(f"cloud: expected at least three points, got {np.count_nonzero(seen)}")
        self.points, self.eyes, self.seen = points, np.broadcast_to(eyes, points.shape), seen
        self.sigma, self.config = sigma, config

    @cached_property
    def _grid(self) -> tuple[FloatArray, int, Curve, Law, FloatArray]:
        """A grid from its eye, as it is searched, NaN = no return, and by how many columns it was turned for that; the
        curve through its returns, the noise of the points of that, and their variances, m^2."""
        grid = np.where(self.seen[..., None], self.points - self.eyes, np.nan)
        turn = turn_of(grid)
        grid = np.roll(grid, turn, axis=1)
        curve = Curve.through(grid[np.isfinite(grid[..., 0])])
        return grid, turn, curve, *self._noise_of(curve, np.zeros(3))

    @property
    def is_linked(self) -> bool:
        """Whether the returns of a grid mostly lie beside others, along rows and along columns, farther than they err.
        Where noise is wider than that, the returns beside one are not those that are nearest to it."""
        if not are_linked(self.seen):
            return False
        grid, _, curve, _, variances = self._grid
        here = np.isfinite(grid[..., 0])
        sigmas = np.zeros(here.shape)
        sigmas[here] = np.sqrt(variances)[curve.number]
        return all(_errs_by_less(np.moveaxis(grid, axis, 0), np.moveaxis(sigmas, axis, 0)) for axis in (0, 1))

    def of_points(self, normals: FloatArray | None, *, placed: bool) -> Found:
        """Planes of points, as if without order, that turn to the normals (N, 3) or, of None, to their eyes. `placed`:
        whether the eyes are where the cloud was seen from, or a guess that normals make needless."""
        origin = self.points[self.seen].mean(axis=0)  # far from the origin nothing is lost
        origin = np.round(origin / 1024.0) * 1024.0
        used, eyes = self.points[self.seen] - origin, self.eyes[self.seen] - origin
        curve = Curve.through(used)
        first = curve.number_of_first()
        eyes = eyes[first]
        law, variances = self._noise_of(curve, eyes)
        first_octave_m = 0.1 * float(np.sqrt(np.median(variances)))  # then it is what planes show
        labels = label_curve(curve, variances, first_octave_m, self.config)
        found = curve.points[None], variances[None, :, None]
        if (labels >= 0).any() and (eyes != eyes[0]).any():
            planes = hesse(moments_of(*found, labels[None], self.config))
            labels = _by_side(eyes, labels, planes, self.config.min_points)
        labels = _largest_first(labels)
        planes = np.empty((0, 4))
        if self.sigma is None or not placed:
            planes = hesse(moments_of(*found, labels[None], self.config))
        spread = self._fitting_variances(law, curve.points[None], planes, labels[None], eyes[None])
        cloud = curve.points[None], spread[..., None]
        n_planes = int(labels.max(initial=-1)) + 1
        sides, by_eye = means_of(eyes, labels, n_planes), np.ones(n_planes, dtype=bool)
        if normals is not None:
            ahead, agreed = _ahead_of(curve.points, normals[self.seen][first], labels, n_planes)
            sides, by_eye = np.where(agreed[:, None], ahead, sides), placed | ~agreed
        views = eyes[None] if placed or scatter_along_beams(curve.points, eyes, labels, planes) else None
        fitted = fit_labelled(*cloud, labels[None], sides, self.config, views=views, stated=self.sigma is not None)
        cells, groups = cells_of(fitted.extents, self.config), curve.neighbourhoods()
        outlines = outlines_of_groups(curve.points, groups, labels, fitted.frames, cells)
        drawn = fitted.with_outlines(or_rectangles(outlines, fitted.extents))
        return Found(labels[curve.number], drawn, origin, fitted, spread[0], by_eye)

    def of_grid(self) -> Found:
        """Planes of a grid."""
        eye = self.eyes.reshape(-1, 3)[0]
        grid, turn, curve, law, variances = self._grid
        here = np.isfinite(grid[..., 0])
        spread = np.ones(here.shape)
        spread[here] = variances[curve.number] if self.sigma is None else self.sigma**2
        found = label_scans(grid, sigma=np.sqrt(spread), viewpoints=np.zeros(3), config=self.config)
        labels = once = _largest_first(found.labels)
        first = curve.number_of_first()
        if len(first) < len(curve.number):  # copies take part in the search, and tell the fit nothing
            counted = here.copy()
            counted[here] = first[curve.number] == np.arange(len(curve.number))
            labels = _largest_first(found.labels, counted, self.config.min_points)
            once = np.where(counted, labels, -1)
        if self.sigma is None:
            planes = hesse(moments_of(grid, spread[..., None], labels, self.config))
            spread = self._fitting_variances(law, grid, planes, labels, np.zeros(3))
        eyes = np.zeros((int(labels.max(initial=-1)) + 1, 3))
        views, stated = np.zeros((len(grid), 1, 3)), self.sigma is not None
        fitted = fit_labelled(grid, spread[..., None], once, eyes, self.config, views=views, stated=stated)
        drawn = fitted.with_outlines(outlines_in(fitted.frames, grid, labels, fitted.extents, self.config))
        own = np.full(here.shape, -1)
        own[here] = once[here][first][curve.number]  # of copies as well
        own = np.roll(own, -turn, axis=1)[self.seen]
        return Found(own, drawn, eye, fitted, spread[here][first], np.ones(len(drawn), dtype=bool))

    def _noise_of(self, curve: Curve, eyes: FloatArray) -> tuple[Law, FloatArray]:
        """For tests: what is stated, and no less than points show; and the variances of the distinct points, m^2."""
        ranges = np.linalg.norm(curve.points - eyes, axis=1)
        shown = curve.noise_law(ranges)
        if shown is None and self.sigma is None:
            expected = "a standard deviation, for the cloud shows no flat places to measure it at"
            raise ValueError(f"sigma: expected {expected}")
        least = 1e-4 if self.sigma is None else as_positive("sigma", self.sigma)  # a cloud made up has none
        at, variances = shown or (np.zeros(1), np.zeros(1))
        law = partial(np.interp, xp=at, fp=np.maximum(variances, least**2))
        near = curve.neighbourhoods()  # by its own range alone a point that is measured too short has less noise
        return law, law((np.bincount(near, ranges) / np.maximum(np.bincount(near), 1))[near])

    def _fitting_variances(
        self, law: Law, points: FloatArray, planes: FloatArray, labels: np.ndarray, eyes: FloatArray
    ) -> FloatArray:
        """For covariances, (S, B), m^2: what is stated, else that of points by how far their planes are along their
        beams; 1 of no return (NaN). By where a point was measured, alone or with its neighbours, those measured too
        short would weigh more. Beams meet their planes at most twice as far, or half as far, as their points are.
        `eyes`: shape (S, B, 3) or (3,), m."""
        here = np.isfinite(points[..., 0])
        if self.sigma is not None:
            return np.where(here, self.sigma**2, 1.0)
        away = points - eyes
        ranges = np.linalg.norm(away, axis=-1)
        if len(planes):
            normals, d = planes[labels, :3], planes[labels, 3]
            along, to_plane = (normals * away).sum(axis=-1), d - (normals * eyes).sum(axis=-1)
            share = np.divide(to_plane, along, out=np.ones(along.shape), where=(labels >= 0) & (along != 0.0))
            ranges = ranges * np.clip(share, 0.5, 2.0)
        return np.where(here, law(ranges), 1.0)


def _errs_by_less(grid: FloatArray, sigmas: FloatArray) -> bool:
    """Whether of the returns of a grid (S, B, 3) no more than one in twenty errs so much that two of its sigmas (S, B)
    are farther than the distance from row to row there, taken over eight of them."""
    here, there = grid[8:], grid[:-8]
    both = np.isfinite(here[..., 0]) & np.isfinite(there[..., 0])
    apart = np.linalg.norm(here[both] - there[both], axis=1) / 8
    return bool(np.count_nonzero(apart < 2.0 * sigmas[8:][both]) <= 0.05 * len(apart))


def _largest_first(labels: np.ndarray, counted: np.ndarray | None = None, fewest: int = 1) -> np.ndarray:
    """The same regions, those with most points first; of equal ones the one that comes first. Of points that are
    `counted`, bool, all if None; regions of fewer than `fewest` are left out."""
    held = labels >= 0 if counted is None else counted & (labels >= 0)
    counts = np.bincount(labels[held], minlength=int(labels.max(initial=0)) + 1)
    order = np.argsort(-counts, kind="stable")
    return renumbered(labels, order[counts[order] >= fewest], len(counts))


def _by_side(eyes: FloatArray, labels: np.ndarray, planes: FloatArray, fewest: int) -> np.ndarray:
    """Labels (N,) where planes that were seen from both sides, by the eyes (N, 3) of `fewest` points on either, are
    two: a wall has a thickness, whatever the noise."""
    own = planes[labels]
    behind = (labels >= 0) & (np.einsum("ni,ni->n", eyes, own[:, :3]) < own[:, 3])
    back, counts = (np.bincount(labels[which], minlength=len(planes)) for which in (behind, labels >= 0))
    both = np.minimum(back, counts - back) >= fewest
    return np.where(behind & both[labels], labels + len(planes), labels)


def _ahead_of(
    points: FloatArray, normals: FloatArray, labels: np.ndarray, n_planes: int
) -> tuple[FloatArray, np.ndarray]:
    """Where normals (N, 3) of the points of every plane point to, (n_planes, 3), m; and whether to one side. Where
    their mean is shorter than one half, they point both ways."""
    lengths = np.linalg.norm(normals, axis=1)
    usable = np.isfinite(lengths) & (lengths > 0.0)
    units = normals / np.where(usable, lengths, 1.0)[:, None]
    mean = means_of(units, np.where(usable, labels, -1), n_planes)
    return means_of(points, labels, n_planes) + mean, np.linalg.norm(mean, axis=1) >= 0.5
