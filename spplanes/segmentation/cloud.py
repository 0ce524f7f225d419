"""Planes of one cloud in one call: any array of points or Open3D cloud, in any order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_float_array, as_shape, check_instance
from spplanes.fitting.rounding import coordinate_steps
from spplanes.plane import Plane
from spplanes.segmentation.cloud_search import CloudSearch, Found
from spplanes.segmentation.config import MapperConfig, ValidationConfig
from spplanes.segmentation.scans import DEFAULT
from spplanes.segmentation.sheet import means_of
from spplanes.segmentation.validation.one_plane import could_be_seen


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
    config: MapperConfig = DEFAULT,
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
    points = _points_of(cloud)
    job = CloudSearch(points, _eyes_of(viewpoint, points), sigma, config)
    if points.ndim == 3 and normals is not None:
        raise ValueError("normals: expected none for a grid (S, B, 3), whose planes turn to its viewpoint")
    if normals is not None:
        normals = as_shape("normals", normals, (len(points), 3), finite=False)
    elif viewpoint is None:
        normals = _normals_in(cloud, points)
    if points.ndim == 3 and job.is_linked:
        return _told(job, job.of_grid())
    return _told(job, job.of_points(normals, placed=viewpoint is not None or points.ndim == 3))


def _told(job: CloudSearch, found: Found) -> CloudPlanes:
    """What was found, about the cloud's own origin, with what is to be said of it."""
    back = np.eye(4)
    back[:3, 3] = found.origin
    planes = [plane.transform(back) for plane in found.planes]
    labels = np.full(job.seen.shape, -1, dtype=np.int32)
    labels[job.seen] = found.labels
    n_used, n_distinct = int(job.seen.sum()), len(found.variances)
    on_planes = round(float(found.fitted.counts.sum()))
    coverage = Coverage(job.seen.size, job.seen.size - n_used, n_used - n_distinct, on_planes, n_distinct - on_planes)
    sigma, octave = float(np.sqrt(np.median(found.variances) * found.fitted.noise_factor)), found.fitted.octave_sigma_m
    source = "as given, and no less than" if job.sigma is not None else "measured:"
    source += f" points scatter by {1e3 * sigma:.2g} mm about their planes, and neighbours share an error of "
    noise = CloudNoise(sigma, octave, source + f"{1e3 * octave:.2g} mm an octave")
    eyes = means_of(job.eyes[job.seen], found.labels, len(planes))
    warnings = _warnings(job, coverage, sigma, placed=bool(found.by_eye.any()))
    told = CloudPlanes((labels, planes))
    told.noise, told.coverage, told.warnings = noise, coverage, warnings
    told.flags = _flags(job, planes, eyes, found.by_eye)
    return told


def _flags(job: CloudSearch, planes: list[Plane], eyes: FloatArray, by_eye: np.ndarray) -> list[str]:
    ranges = np.linalg.norm(job.points[job.seen] - job.eyes[job.seen], axis=1)
    near, rules = 0.1 * float(np.median(ranges)), ValidationConfig()  # what is nearer carries the sensor
    flags = []
    for plane, eye, told in zip(planes, eyes, by_eye, strict=True):
        if told and np.linalg.norm(plane.centre - eye) < near:
            flags.append("too near")
        else:
            flags.append("" if not told or could_be_seen(plane, eye, rules) else "edge-on")
    return flags


def _warnings(job: CloudSearch, coverage: Coverage, sigma: float, *, placed: bool) -> list[str]:
    used, eyes = job.points[job.seen], job.eyes[job.seen]
    low, high, found = used.min(axis=0), used.max(axis=0), []
    size = float(np.linalg.norm(high - low))
    step = float(coordinate_steps(used).max())
    outside = float(np.linalg.norm(np.maximum(np.maximum(low - eyes, eyes - high), 0.0), axis=1).min())
    if size > 2000.0:
        found.append(f"the cloud is {size:,.0f} m wide: are its coordinates millimetres? metres are expected")
    if job.sigma is not None and sigma > 3.0 * job.sigma:
        found.append(
            f"points scatter by {1e3 * sigma:.2g} mm about their planes, {sigma / job.sigma:.0f} times the sigma "
            "given: some of these planes may be two, such as both sides of a wall"
        )
    if step > 2.0 * sigma:  # with more noise than that, rounding averages out
        found.append(
            f"coordinates come in steps of {step:.3g} m and their noise is less than half of that: "
            "planes across an axis may be off by half a step"
        )
    if placed and outside > size:
        found.append(f"the viewpoint lies {outside:.3g} m outside of the cloud: normals may point to either side")
    if coverage.share < 0.5:
        found.append(f"{100.0 * coverage.share:.0f} % of the points are on planes: the rest is on none, or too few")
    return found


def _points_of(cloud: Any) -> FloatArray:
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
