"""Planes of one cloud in one call: any array of points or Open3D cloud, organised or not."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import TOO_LARGE, FloatArray, as_float_array, as_positive, as_shape
from spplanes.clouds.arrange import arrange
from spplanes.clouds.scatter import scatter_of
from spplanes.plane import Plane
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.scans import segment_scans

_DEFAULT = MapperConfig()
#: Clouds without any noise (made, not measured) get this much, m: no covariance is zero.
_LEAST_SIGMA_M = 1e-4


def segment_cloud(
    cloud: Any, *, sigma: float | None = None, viewpoint: ArrayLike = (0.0, 0.0, 0.0), config: MapperConfig = _DEFAULT
) -> tuple[np.ndarray, list[Plane]]:
    """Planes of one cloud, and the plane of every point.

    Args:
        cloud: points in the sensor's frame, or any other with its ``viewpoint``, m: an array (N, 3), or (S, B, 3) where
            rows are scan lines or image rows; a structured array (N,) or (S, B) with fields x, y, z; an
            ``open3d.geometry.PointCloud`` or ``open3d.t.geometry.PointCloud``. What is not finite is no return.
        sigma: standard deviation of the points, m; None: measured, from how ranges of neighbouring beams scatter.
        viewpoint: where the cloud was seen from, shape (3,): points without order are arranged as a range image round
            it, and normals point to it.
        config: settings of the segmentation.

    Returns:
        labels: plane of every point, shape (N,) or (S, B), int32, index into planes; -1 = none, or hidden by another.
        planes: with outlines, in the order of the segmentation.

    Raises:
        ValueError: what is no cloud, fewer than three points, a sigma that is not positive, or none given where the
            cloud has too few neighbours to measure it.
    """
    points = points_of(cloud)
    eye = as_shape("viewpoint", viewpoint, (3,))
    seen = np.asarray(np.isfinite(points).all(axis=-1))
    largest = float(np.abs(points[seen]).max(initial=0.0))
    if largest >= TOO_LARGE:
        raise ValueError(f"cloud: expected numbers below {TOO_LARGE:g}, got {largest:.3g}")
    seen &= (np.abs(points - eye) > 1.0 / TOO_LARGE).any(axis=-1)  # at the viewpoint itself there is no direction
    if np.count_nonzero(seen) < 3:
        raise ValueError(f"cloud: expected at least three points, got {np.count_nonzero(seen)}")
    grid = arrange(np.where(seen[..., None], points - eye, np.nan))
    noise = _sigma_of(grid) if sigma is None else as_positive("sigma", sigma)
    grid_labels, planes = segment_scans(grid, sigma=noise, viewpoints=(0.0, 0.0, 0.0), config=config)
    back = np.eye(4)
    back[:3, 3] = eye
    return _labels_of(points - eye, grid, grid_labels), [plane.transform(back) for plane in planes]


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


def _sigma_of(grid: FloatArray) -> float:
    scatter = scatter_of(grid)
    if scatter is None:
        raise ValueError("sigma: expected a standard deviation, for the cloud has too few neighbours to measure it")
    return max(scatter.surface_m, _LEAST_SIGMA_M)


def _labels_of(points: FloatArray, grid: FloatArray, labels: np.ndarray) -> np.ndarray:
    """Labels in the order of the points: a cell of the grid holds a point of the cloud to the last bit."""
    rows, cells = (np.ascontiguousarray(one.reshape(-1, 3)).view("V24").ravel() for one in (points + 0.0, grid + 0.0))
    names, of_rows = np.unique(np.concatenate([rows, cells]), return_inverse=True)
    of_name = np.full(len(names), -1, dtype=np.int32)
    flat = labels.ravel()
    held = flat >= 0
    of_name[of_rows[len(rows) :][held]] = flat[held]
    return of_name[of_rows[: len(rows)]].reshape(points.shape[:-1])
