"""Planes of one cloud in one call: any array of points or Open3D cloud, in any order."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import TOO_LARGE, FloatArray, as_float_array, as_positive, as_shape, check_instance
from spplanes.clouds.arrange import are_linked, arrange
from spplanes.clouds.octree import Curve, NoiseLaw
from spplanes.clouds.scatter import scatter_along_beams
from spplanes.fitting.rounding import coordinate_steps
from spplanes.outlines.outline import outlines_of_groups
from spplanes.plane import Plane
from spplanes.segmentation.clustering.growing import hesse
from spplanes.segmentation.config import MapperConfig, ValidationConfig
from spplanes.segmentation.planes import FittedPlanes, cells_of, fit_labelled, moments_of, or_rectangles, outlines_in
from spplanes.segmentation.scans import label_scans
from spplanes.segmentation.unordered import label_curve
from spplanes.segmentation.validation.one_plane import could_be_seen

_DEFAULT = MapperConfig()
#: Clouds without any noise (made, not measured) get this much, m: no covariance is zero.
_LEAST_SIGMA_M = 1e-4
#: The shared error that the search begins with, as a share of the noise; then it is what planes show.
_FIRST_OCTAVE = 0.1
#: Clouds with less than this share of their points on planes are told of.
_LOW_COVERAGE = 0.5
#: Clouds wider than this are probably not in metres.
_WIDE_M = 2000.0
#: Planes nearer than this share of the usual range are of what carries the sensor.
_TOO_NEAR = 0.1
#: Points that scatter by so many times the sigma that was given are hardly of single planes.
_MUCH_MORE = 3.0
#: Normals of the points of a plane whose mean is shorter than this point both ways: they tell no side.
_AGREED = 0.5
#: Beams meet their planes at most so many times farther, or nearer, than their points are.
_FARTHER = 2.0
#: Grids whose returns are linked are searched along rows and columns where no more than this share of them errs so much
#: that so many sigmas are farther than the distance there, taken over so many of them.
_MOST_BLURRED, _BLURRED, _STEPS = 0.05, 2.0, 8


@dataclass(frozen=True)
class CloudNoise:
    """What errors the planes of a cloud were found and told with."""

    sigma_m: float
    """Standard deviation of the points about their planes, the median over them, m."""
    octave_sigma_m: float
    """Standard deviation of an octave of the error that neighbouring points share, m (`fitting.shared_error`)."""
    source: str
    """Where the numbers come from, one sentence."""


@dataclass(frozen=True)
class Coverage:
    """Every point of a cloud, counted once."""

    total: int
    """Given."""
    no_return: int
    """Not finite, or at the viewpoint."""
    repeated: int
    """The same point as another one, to the last bit; counted, and used once."""
    on_planes: int
    """Distinct points on planes."""
    on_no_plane: int
    """Distinct points on nothing that is a plane, or on fewer than `MapperConfig.min_points`."""

    @property
    def share(self) -> float:
        """Share of the distinct returns that are on planes."""
        return self.on_planes / max(self.on_planes + self.on_no_plane, 1)


class CloudPlanes(tuple[np.ndarray, "list[Plane]"]):
    """The planes of one cloud: unpacks as ``labels, planes``, and tells what they were found with."""

    noise: CloudNoise
    """Noise of the points, and what they share."""
    coverage: Coverage
    """What became of every point."""
    flags: list[str]
    """Of every plane: "" or why it may be none of the scene's, "edge-on" or "too near"."""
    warnings: list[str]
    """What speaks against these planes, a sentence each."""

    def __new__(
        cls,
        labels: np.ndarray,
        planes: list[Plane],
        noise: CloudNoise,
        coverage: Coverage,
        flags: list[str],
        warnings: list[str],
    ) -> CloudPlanes:
        """Put together what was found."""
        self = super().__new__(cls, (labels, planes))
        self.noise, self.coverage, self.flags, self.warnings = noise, coverage, flags, warnings
        return self

    @property
    def labels(self) -> np.ndarray:
        """Plane of every point, index into planes, shape (N,) or (S, B), int32; -1 = none."""
        return self[0]

    @property
    def planes(self) -> list[Plane]:
        """The planes with outlines, those with most points first."""
        return self[1]


def segment_cloud(
    cloud: Any,
    *,
    sigma: float | None = None,
    viewpoint: ArrayLike | None = None,
    normals: ArrayLike | None = None,
    config: MapperConfig = _DEFAULT,
) -> CloudPlanes:
    """Planes of one cloud, and the plane of every point.

    Points (N, 3) have no order: whatever it is, the planes are the same. Grids (S, B, 3) are searched along their rows
    and columns, which is faster; where holes leave many returns alone there, or noise is wider than the distance of
    many from the next, as points. The error that neighbouring points share is found in the cloud, whatever sigma says,
    and is part of the planes' covariances; so is what rounded coordinates have in common. Points that are repeated to
    the last bit are counted in ``coverage``; they make no plane more certain than its distinct points do.

    Args:
        cloud: points in any frame, m: an array (N, 3), or (S, B, 3) where rows are scan lines or image rows, in the
            sensor's frame or with its ``viewpoint``; a structured array (N,) or (S, B) with fields x, y, z; an
            ``open3d.geometry.PointCloud`` or ``open3d.t.geometry.PointCloud``. What is not finite is no return.
        sigma: standard deviation of the points, m, at least; None: measured, from how points scatter about planes
            through their neighbours.
        viewpoint: where the cloud was seen from, shape (3,), or every point of points (N, 3) by itself, shape (N, 3),
            m: normals point there, noise lies along beams from there. None: the normals of an Open3D cloud that has
            some, else the origin; noise lies along beams from there where points scatter as it would, else along
            normals.
        normals: of points (N, 3), shape (N, 3), to turn the planes' by instead. Those that are zero or NaN are left
            out; planes whose points have none, or some to either side, turn to the viewpoint.
        config: settings of the segmentation.

    Returns:
        ``labels, planes``, with more as attributes, see `CloudPlanes`.

    Raises:
        ValueError: what is no cloud, fewer than three points, a sigma that is not positive, or none given where the
            cloud shows no flat places to measure it at, or normals of a grid.
    """
    check_instance("config", config, MapperConfig)
    points = points_of(cloud)
    job = _Job.checked(points, _eyes_of(viewpoint, points), sigma, config)
    if points.ndim == 3 and normals is not None:
        raise ValueError("normals: expected none for a grid (S, B, 3), whose planes turn to its viewpoint")
    if normals is not None:
        normals = as_shape("normals", normals, (len(points), 3), finite=False)
    elif viewpoint is None:
        normals = _normals_in(cloud, points)
    if points.ndim == 3 and job.is_linked:
        return job.of_grid()
    return job.of_points(normals, placed=viewpoint is not None or points.ndim == 3)


@dataclass(eq=False)
class _Job:
    """A cloud that is searched for planes."""

    points: FloatArray
    """Shape (N, 3) or (S, B, 3), m."""
    seen: np.ndarray
    """Which are returns, shape (N,) or (S, B)."""
    eyes: FloatArray
    """Where they were seen from, of the points' shape, m."""
    sigma: float | None
    """As given."""
    config: MapperConfig
    """As given."""

    @classmethod
    def checked(cls, points: FloatArray, eyes: FloatArray, sigma: float | None, config: MapperConfig) -> _Job:
        """Points, seen from one eye (3,) or each from its own (N, 3), with the returns among them told."""
        seen = np.asarray(np.isfinite(points).all(axis=-1))
        largest = float(np.abs(points[seen]).max(initial=0.0))
        if largest >= TOO_LARGE:
            raise ValueError(f"cloud: expected numbers below {TOO_LARGE:g}, got {largest:.3g}")
        seen &= (np.abs(points - eyes) > 1.0 / TOO_LARGE).any(axis=-1)  # at the viewpoint itself there is no direction
        if np.count_nonzero(seen) < 3:
            raise ValueError(f"cloud: expected at least three points, got {np.count_nonzero(seen)}")
        return cls(points, seen, np.broadcast_to(eyes, points.shape), sigma, config)

    @cached_property
    def _grid(self) -> tuple[FloatArray, Curve, NoiseLaw, FloatArray]:
        """A grid from its eye, as it is searched, NaN = no return; the curve through its returns, the noise of the
        points of that, and their variances, m^2."""
        grid = arrange(np.where(self.seen[..., None], self.points - self.eyes, np.nan))
        curve = Curve.through(grid[np.isfinite(grid[..., 0])])
        return grid, curve, *self._noise_of(curve, np.zeros(3))

    @property
    def is_linked(self) -> bool:
        """Whether the returns of a grid mostly lie beside others, along rows and along columns, farther than they err.

        Where noise is wider than that, the returns beside one are not those that are nearest to it.
        """
        if not are_linked(self.seen):
            return False
        grid, curve, _, variances = self._grid
        here = np.isfinite(grid[..., 0])
        sigmas = np.zeros(here.shape)
        sigmas[here] = np.sqrt(variances)[curve.number]
        return all(_errs_by_less(np.moveaxis(grid, axis, 0), np.moveaxis(sigmas, axis, 0)) for axis in (0, 1))

    def of_points(self, normals: FloatArray | None, *, placed: bool) -> CloudPlanes:
        """Planes of points, as if without order.

        Args:
            normals: of all points, shape (N, 3), or None: planes turn to their eyes.
            placed: whether the eyes are where the cloud was seen from, or a guess that normals make needless.
        """
        origin = self.points[self.seen].mean(axis=0)  # far from the origin nothing is lost
        origin = np.round(origin / 1024.0) * 1024.0
        used, eyes = self.points[self.seen] - origin, self.eyes[self.seen] - origin
        curve = Curve.through(used)
        first = curve.number_of_first()
        eyes = eyes[first]
        law, variances = self._noise_of(curve, eyes)
        first_octave_m = _FIRST_OCTAVE * float(np.sqrt(np.median(variances)))
        labels = label_curve(curve, variances, first_octave_m, self.config)
        found = curve.points[None], variances[None, :, None]
        if (labels >= 0).any() and (eyes != eyes[0]).any():
            planes = hesse(moments_of(*found, labels[None], self.config))
            labels = _by_side(eyes, labels, planes, self.config.min_points)
        labels = _largest_first(labels)
        planes = np.empty((0, 4))
        if self.sigma is None or not placed:
            planes = hesse(moments_of(*found, labels[None], self.config))
        if self.sigma is None:
            spread = _fitting_variances(law, curve.points[None], planes, labels[None], eyes[None])
        else:
            spread = np.full((1, len(labels)), self.sigma**2)
        cloud = curve.points[None], spread[..., None]
        n_planes = int(labels.max(initial=-1)) + 1
        sides, by_eye = _mean_of(eyes, labels, n_planes), np.ones(n_planes, dtype=bool)
        if normals is not None:
            ahead, agreed = _ahead_of(curve.points, normals[self.seen][first], labels, n_planes)
            sides, by_eye = np.where(agreed[:, None], ahead, sides), placed | ~agreed
        views = eyes[None] if placed or scatter_along_beams(curve.points, eyes, labels, planes) else None
        fitted = fit_labelled(*cloud, labels[None], sides, self.config, views=views, stated=self.sigma is not None)
        outlines = outlines_of_groups(
            curve.points, curve.neighbourhoods(), labels, fitted.frames, cells_of(fitted.extents, self.config)
        )
        drawn = fitted.with_outlines(or_rectangles(outlines, fitted.extents))
        return self._result(labels[curve.number], drawn, origin, fitted, spread[0], by_eye)

    def of_grid(self) -> CloudPlanes:
        """Planes of a grid."""
        eye = self.eyes.reshape(-1, 3)[0]
        grid, curve, law, variances = self._grid
        here = np.isfinite(grid[..., 0])
        spread = np.ones(here.shape)
        spread[here] = variances[curve.number] if self.sigma is None else self.sigma**2
        found = label_scans(grid, sigma=np.sqrt(spread), viewpoints=np.zeros(3), config=self.config)
        labels = once = _largest_first(found.labels)
        if len(curve.points) < len(curve.number):  # copies take part in the search, and tell the fit nothing
            counted = here.copy()
            counted[here] = curve.number_of_first()[curve.number] == np.arange(len(curve.number))
            labels = _largest_first(found.labels, counted, self.config.min_points)
            once = np.where(counted, labels, -1)
        if self.sigma is None:
            planes = hesse(moments_of(grid, spread[..., None], labels, self.config))
            spread = _fitting_variances(law, grid, planes, labels, np.zeros(3))
        eyes = np.zeros((int(labels.max(initial=-1)) + 1, 3))
        views, stated = np.zeros((len(grid), 1, 3)), self.sigma is not None
        fitted = fit_labelled(grid, spread[..., None], once, eyes, self.config, views=views, stated=stated)
        drawn = fitted.with_outlines(outlines_in(fitted.frames, grid, labels, fitted.extents, self.config))
        own = _labels_of(self.points - eye, grid, once)[self.seen]
        distinct = spread[here][curve.number_of_first()]
        return self._result(own, drawn, eye, fitted, distinct, np.ones(len(drawn), dtype=bool))

    def _noise_of(self, curve: Curve, eyes: FloatArray) -> tuple[NoiseLaw, FloatArray]:
        """For tests: what is stated, and no less than points show; and the variances of the distinct points, m^2."""
        ranges = np.linalg.norm(curve.points - eyes, axis=1)
        shown = curve.noise_law(ranges)
        if shown is None and self.sigma is None:
            raise ValueError(
                "sigma: expected a standard deviation, for the cloud shows no flat places to measure it at"
            )
        least = _LEAST_SIGMA_M if self.sigma is None else as_positive("sigma", self.sigma)
        law = shown or NoiseLaw(np.zeros(1), np.zeros(1))
        law = law._replace(variances=np.maximum(law.variances, least**2))
        return law, law.at(curve.smoothed(ranges))

    def _result(
        self,
        labels: np.ndarray,
        planes: list[Plane],
        origin: FloatArray,
        fitted: FittedPlanes,
        variances: FloatArray,
        by_eye: np.ndarray,
    ) -> CloudPlanes:
        """Put together what was found.

        Args:
            labels: of the returns.
            planes: about the origin.
            origin: where that is, shape (3,), m.
            fitted: counts.
            variances: that the distinct points were fitted with.
            by_eye: whose side the eyes tell, shape (R,), bool.
        """
        back = np.eye(4)
        back[:3, 3] = origin
        planes = [plane.transform(back) for plane in planes]
        every = np.full(self.seen.shape, -1, dtype=np.int32)
        every[self.seen] = labels
        n_used, n_distinct = int(self.seen.sum()), len(variances)
        on_planes = round(float(fitted.counts.sum()))
        coverage = Coverage(
            self.seen.size, self.seen.size - n_used, n_used - n_distinct, on_planes, n_distinct - on_planes
        )
        sigma = float(np.sqrt(np.median(variances) * fitted.noise_factor))
        source = "as given, and no less than" if self.sigma is not None else "measured:"
        noise = CloudNoise(
            sigma,
            fitted.octave_sigma_m,
            f"{source} points scatter by {1e3 * sigma:.2g} mm about their planes, and neighbours share an error of "
            f"{1e3 * fitted.octave_sigma_m:.2g} mm an octave",
        )
        eyes = _mean_of(self.eyes[self.seen], labels, len(planes))
        warnings = self._warnings(coverage, sigma, placed=bool(by_eye.any()))
        return CloudPlanes(every, planes, noise, coverage, self._flags(planes, eyes, by_eye), warnings)

    def _flags(self, planes: list[Plane], eyes: FloatArray, by_eye: np.ndarray) -> list[str]:
        ranges = np.linalg.norm(self.points[self.seen] - self.eyes[self.seen], axis=1)
        near, rules = _TOO_NEAR * float(np.median(ranges)), ValidationConfig()
        flags = []
        for plane, eye, told in zip(planes, eyes, by_eye, strict=True):
            if told and np.linalg.norm(plane.centre - eye) < near:
                flags.append("too near")
            else:
                flags.append("" if not told or could_be_seen(plane, eye, rules) else "edge-on")
        return flags

    def _warnings(self, coverage: Coverage, sigma: float, *, placed: bool) -> list[str]:
        used, eyes = self.points[self.seen], self.eyes[self.seen]
        low, high, found = used.min(axis=0), used.max(axis=0), []
        size = float(np.linalg.norm(high - low))
        step = float(coordinate_steps(used).max())
        outside = float(np.linalg.norm(np.maximum(np.maximum(low - eyes, eyes - high), 0.0), axis=1).min())
        if size > _WIDE_M:
            found.append(f"the cloud is {size:,.0f} m wide: are its coordinates millimetres? metres are expected")
        if self.sigma is not None and sigma > _MUCH_MORE * self.sigma:
            found.append(
                f"points scatter by {1e3 * sigma:.2g} mm about their planes, {sigma / self.sigma:.0f} times the sigma "
                "given: some of these planes may be two, such as both sides of a wall"
            )
        if step > 2.0 * sigma:  # with more noise than that, rounding averages out
            found.append(
                f"coordinates come in steps of {step:.3g} m and their noise is less than half of that: "
                "planes across an axis may be off by half a step"
            )
        if placed and outside > size:
            found.append(f"the viewpoint lies {outside:.3g} m outside of the cloud: normals may point to either side")
        if coverage.share < _LOW_COVERAGE:
            found.append(f"{100.0 * coverage.share:.0f} % of the points are on planes: the rest is on none, or too few")
        return found


def _fitting_variances(
    law: NoiseLaw, points: FloatArray, planes: FloatArray, labels: np.ndarray, eyes: FloatArray
) -> FloatArray:
    """For covariances, shape (S, B), m^2: of points by how far their planes are along their beams, 1 of no return.

    By where a point was measured, alone or with its neighbours, those measured too short would weigh more.

    Args:
        law: how noise goes with the range.
        points, labels: shape (S, B, 3), m, NaN = no return, and (S, B), -1 = none.
        planes: (normal, d) of the labels, shape (R, 4).
        eyes: where they were seen from, shape (S, B, 3) or (3,), m.
    """
    here = np.isfinite(points[..., 0])
    away = points - eyes
    ranges = np.linalg.norm(away, axis=-1)
    if len(planes):
        normals, d = planes[labels, :3], planes[labels, 3]
        along, to_plane = (normals * away).sum(axis=-1), d - (normals * eyes).sum(axis=-1)
        share = np.divide(to_plane, along, out=np.ones(along.shape), where=(labels >= 0) & (along != 0.0))
        ranges = ranges * np.clip(share, 1.0 / _FARTHER, _FARTHER)
    return np.where(here, law.at(ranges), 1.0)


def _errs_by_less(grid: FloatArray, sigmas: FloatArray) -> bool:
    """Whether nearly all returns of a grid (S, B, 3) err, by sigmas (S, B), by much less than to those rows away."""
    both = np.isfinite(grid[_STEPS:, :, 0]) & np.isfinite(grid[:-_STEPS, :, 0])
    apart = np.linalg.norm(grid[_STEPS:][both] - grid[:-_STEPS][both], axis=1) / _STEPS
    return bool(np.count_nonzero(apart < _BLURRED * sigmas[_STEPS:][both]) <= _MOST_BLURRED * len(apart))


def points_of(cloud: Any) -> FloatArray:
    """Points (N, 3) or (S, B, 3) of an array, a structured array or an Open3D cloud; a ValueError for anything else."""
    positions = _positions(cloud)
    names = getattr(getattr(positions, "dtype", None), "names", None)
    if names is not None:
        if not {"x", "y", "z"} <= set(names):
            raise ValueError(f"cloud: expected the fields x, y, z, got {', '.join(names)}")
        positions = np.stack([positions[axis] for axis in "xyz"], axis=-1)
    points = as_float_array("cloud", positions)
    if points.ndim not in (2, 3) or points.shape[-1] != 3:
        raise ValueError(f"cloud: expected shape (N, 3) or (S, B, 3), got {points.shape}")
    return points


def _positions(cloud: Any) -> Any:
    """What holds the numbers: of Open3D's legacy clouds ``points``, of tensor clouds ``point.positions``."""
    if isinstance(cloud, np.ndarray):
        return cloud
    tensors = getattr(cloud, "point", None)
    if tensors is not None:
        try:
            return tensors["positions"].cpu().numpy()
        except (KeyError, RuntimeError, AttributeError) as error:
            raise ValueError("cloud: expected a point cloud with positions, got one without") from error
    return np.asarray(cloud.points) if hasattr(cloud, "points") else cloud


def _normals_in(cloud: Any, points: FloatArray) -> FloatArray | None:
    """Normals (N, 3) of an Open3D cloud that has some."""
    if isinstance(cloud, np.ndarray):
        return None
    tensors = getattr(cloud, "point", None)
    if tensors is not None:
        return as_float_array("normals", tensors["normals"].cpu().numpy()) if "normals" in tensors else None
    normals = np.asarray(getattr(cloud, "normals", []))
    return as_float_array("normals", normals) if len(normals) == len(points) else None


def _eyes_of(viewpoint: ArrayLike | None, points: FloatArray) -> FloatArray:
    """Viewpoint of all points (3,), or of each (N, 3); None: the origin."""
    eyes = np.zeros(3) if viewpoint is None else as_float_array("viewpoint", viewpoint)
    if eyes.shape == (3,) or points.ndim != 2:
        return as_shape("viewpoint", eyes, (3,))
    if eyes.shape != points.shape:
        raise ValueError(f"viewpoint: expected shape (3,) or {points.shape}, got {eyes.shape}")
    return as_shape("viewpoint", eyes, points.shape)


def _largest_first(labels: np.ndarray, counted: np.ndarray | None = None, fewest: int = 1) -> np.ndarray:
    """The same regions, those with most points first; of equal ones the one that comes first.

    Args:
        labels: region of every point, -1 = none.
        counted: which points are counted, of the labels' shape, bool; None: all.
        fewest: regions of fewer are left out.
    """
    held = labels >= 0 if counted is None else counted & (labels >= 0)
    counts = np.bincount(labels[held], minlength=int(labels.max(initial=0)) + 1)
    order = np.argsort(-counts, kind="stable")
    order = order[counts[order] >= fewest]
    rank = np.full(len(counts) + 1, -1)
    rank[order] = np.arange(len(order))
    return rank[labels]


def _mean_of(values: FloatArray, labels: np.ndarray, n_planes: int) -> FloatArray:
    """Mean of values (N, 3) of the points of every plane, shape (n_planes, 3)."""
    held = labels >= 0
    counts = np.maximum(np.bincount(labels[held], minlength=n_planes), 1)
    sums = [np.bincount(labels[held], values[held, k], minlength=n_planes) for k in range(3)]
    return np.stack(sums, axis=1) / counts[:, None]


def _by_side(eyes: FloatArray, labels: np.ndarray, planes: FloatArray, fewest: int) -> np.ndarray:
    """Labels where planes that were seen from both sides are two: a wall has a thickness, whatever the noise.

    Args:
        eyes: where each point was seen from, shape (N, 3), m.
        labels: plane of every point, shape (N,), -1 = none.
        planes: (normal, d), shape (R, 4).
        fewest: points that either side must have.
    """
    own = planes[labels]
    behind = (labels >= 0) & (np.einsum("ni,ni->n", eyes, own[:, :3]) < own[:, 3])
    back, counts = (np.bincount(labels[which], minlength=len(planes)) for which in (behind, labels >= 0))
    both = np.minimum(back, counts - back) >= fewest
    return np.where(behind & both[labels], labels + len(planes), labels)


def _ahead_of(
    points: FloatArray, normals: FloatArray, labels: np.ndarray, n_planes: int
) -> tuple[FloatArray, np.ndarray]:
    """Where normals (N, 3) of the points of every plane point to, shape (n_planes, 3), m, and whether they agree."""
    lengths = np.linalg.norm(normals, axis=1)
    usable = np.isfinite(lengths) & (lengths > 0.0)
    units = normals / np.where(usable, lengths, 1.0)[:, None]
    mean = _mean_of(units, np.where(usable, labels, -1), n_planes)
    return _mean_of(points, labels, n_planes) + mean, np.linalg.norm(mean, axis=1) >= _AGREED


def _labels_of(points: FloatArray, grid: FloatArray, labels: np.ndarray) -> np.ndarray:
    """Labels in the order of the points: a cell of the grid holds a point of the cloud to the last bit."""
    rows, cells = (np.ascontiguousarray(one.reshape(-1, 3)).view("V24").ravel() for one in (points + 0.0, grid + 0.0))
    names, of_rows = np.unique(np.concatenate([rows, cells]), return_inverse=True)
    of_name = np.full(len(names), -1, dtype=np.int32)
    flat = labels.ravel()
    held = flat >= 0
    of_name[of_rows[len(rows) :][held]] = flat[held]
    return of_name[of_rows[: len(rows)]].reshape(points.shape[:-1])
