"""Planes of one cloud: what `spplanes fit` does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from scipy.spatial import KDTree

from slam.errors import LogError
from slam.io.clouds import Cloud
from slam.map.map_planes import MapPlane
from spplanes import MapperConfig, Plane, segment_scans
from spplanes._check import FloatArray
from spplanes.clouds._arrange_kernels import returns_of
from spplanes.clouds.arrange import arrange
from spplanes.clouds.scatter import scatter_of
from spplanes.noise import DepthCameraModel
from spplanes.segmentation.validation.config import ValidationConfig
from spplanes.segmentation.validation.one_plane import could_be_seen

#: What is taken where neither the caller nor the cloud says how its points scatter, m.
ASSUMED_SIGMA_M = 0.01
#: Points that share a direction with a nearer one are on its plane within so many standard deviations.
_ON_PLANE_SIGMAS = 3.0
#: Clouds without any noise (made, not measured) get this much, m: no covariance is zero.
_LEAST_SIGMA_M = 1e-4


@dataclass(frozen=True)
class PointCounts:
    """Every point of a cloud, counted once."""

    total: int
    """In the file."""
    no_return: int
    """Not finite, or at the sensor."""
    repeated: int
    """In lines that a file holds twice."""
    on_planes: int
    """On a plane, those that share a direction with a nearer one included."""
    edge_on: int
    """On planes seen edge-on from the viewpoint: a line of the scan, not a surface."""
    on_no_plane: int
    """On nothing that is one, or on planes of fewer points than asked for."""

    @property
    def returns(self) -> int:
        """Points that are looked at."""
        return self.total - self.no_return - self.repeated


@dataclass(frozen=True, eq=False)
class CloudPlanes:
    """The planes of a cloud."""

    planes: list[Plane]
    """In the frame of the file, those with most points first."""
    points: FloatArray
    """The returns in that frame, shape (N, 3), m."""
    labels: np.ndarray
    """Plane of every return, shape (N,), index into planes; -1: none."""
    sigma_m: float
    """Standard deviation of the points that the planes were found with, m."""
    note: str
    """Where it comes from, one sentence."""
    viewpoint: FloatArray
    """Where the cloud was seen from, in that frame, shape (3,), m."""
    counts: PointCounts
    """What became of every point of the file."""

    @property
    def map_planes(self) -> list[MapPlane]:
        """The planes as those of a map of one scan."""
        return [
            MapPlane(index, plane, plane.outline or shapely.Polygon(), 1, ("scan",))
            for index, plane in enumerate(self.planes)
        ]

    @property
    def share(self) -> float:
        """Share of the returns that belong to a plane."""
        return self.counts.on_planes / max(self.counts.returns, 1)

    def at_least(self, n_points: int) -> CloudPlanes:
        """Only the planes of so many points; they come first."""
        kept = sum(plane.n_points >= n_points for plane in self.planes)
        labels = np.where(self.labels < kept, self.labels, -1)
        on_planes = int(np.count_nonzero(labels >= 0))
        rest = self.counts.on_no_plane + self.counts.on_planes - on_planes
        counts = replace(self.counts, on_planes=on_planes, on_no_plane=rest)
        return replace(self, planes=self.planes[:kept], labels=labels, counts=counts)

    def table(self) -> list[dict[str, Any]]:
        """The planes in plain numbers: d with its standard deviation at the centre, the worse of the two tilts."""
        rows = []
        for index, plane in enumerate(self.planes):
            sigma_d, *tilts = np.sqrt(np.diag(plane.covariance)).tolist()
            rows.append(
                {
                    "id": index,
                    "normal": plane.normal.tolist(),
                    "d": plane.d,
                    "sigma_d_m": sigma_d,
                    "sigma_tilt_deg": math.degrees(max(tilts)),
                    "n_points": plane.n_points,
                    "area_m2": 0.0 if plane.outline is None else plane.outline.area,
                }
            )
        return rows


def fit_cloud(
    cloud: Cloud, source: Path, *, sigma_m: float | None = None, viewpoint: Sequence[float] = (0.0, 0.0, 0.0)
) -> CloudPlanes:
    """Find the planes of a cloud.

    Args:
        cloud: points in the sensor's frame.
        source: for messages.
        sigma_m: standard deviation of the points, the same in every direction, m; None: measured in the cloud.
        viewpoint: where a cloud in another frame than the sensor's was seen from, m: it is arranged as a range image
            round this place, and normals point there.

    Raises:
        LogError: no three points.
    """
    if sum(np.isfinite(cloud.points[..., 0]).ravel()) < 3:
        raise LogError(source, "expected at least three points, got fewer")
    eye = np.asarray(viewpoint, dtype=np.float64)
    grid = arrange(cloud.points - eye)
    sigma, note = (sigma_m, "as given") if sigma_m is not None else _sigma_of(grid)
    of_points = sigma if sigma_m is not None or not cloud.is_depth_image else _grown(sigma, grid)
    labels, planes = segment_scans(grid, sigma=of_points, viewpoints=(0.0, 0.0, 0.0), config=MapperConfig())
    real = [could_be_seen(plane, np.zeros(3), ValidationConfig()) for plane in planes]
    edge_on = np.isin(labels, np.flatnonzero(~np.array(real, dtype=bool)))
    back = np.eye(4) if cloud.world_T_sensor is None else cloud.world_T_sensor.copy()
    back[:3, 3] += back[:3, :3] @ eye
    order = sorted(np.flatnonzero(real).tolist(), key=lambda index: (-planes[index].n_points, index))
    rank = np.full(len(planes) + 1, -1)
    rank[order] = np.arange(len(order))
    chosen = [planes[k] for k in order]
    points, number = _with_hidden(cloud.points - eye, grid, rank[labels], chosen, of_points)
    counts = _counted(cloud.points, len(points), number, int(np.count_nonzero(edge_on)))
    moved = points @ back[:3, :3].T + back[:3, 3]
    return CloudPlanes([plane.transform(back) for plane in chosen], moved, number, sigma, note, back[:3, 3], counts)


def _with_hidden(
    points: FloatArray, grid: FloatArray, labels: np.ndarray, planes: Sequence[Plane], sigma: FloatArray | float
) -> tuple[FloatArray, np.ndarray]:
    """All returns (N, 3) and their planes (N,): of those that share a cell of the range image it holds the nearest.

    The others are of the plane of their cell where they lie on it.
    """
    seen = np.isfinite(grid[..., 0])
    shown, number = grid[seen], labels[seen]
    used = returns_of(np.ascontiguousarray(points.reshape(-1, 3), dtype=np.float64))
    if points.ndim == 3 or len(used) == len(shown) or not len(shown):
        return shown, number
    of_shown = np.broadcast_to(np.asarray(sigma), seen.shape)[seen]
    apart, nearest = KDTree(shown).query(used)
    nearest = np.asarray(nearest)
    own = np.where(apart == 0.0, number[nearest], -1)
    hidden = np.flatnonzero((apart > 0.0) & (number[nearest] >= 0))
    plane = number[nearest[hidden]]
    hesse = np.array([(*one.normal, one.d) for one in planes]).reshape(-1, 4)
    off = np.abs(np.einsum("ki,ki->k", used[hidden], hesse[plane, :3]) - hesse[plane, 3])
    own[hidden] = np.where(off <= _ON_PLANE_SIGMAS * of_shown[nearest[hidden]], plane, -1)
    return used, own


def _counted(points: FloatArray, n_used: int, number: np.ndarray, edge_on: int) -> PointCounts:
    flat = points.reshape(-1, 3)
    n_returns = len(returns_of(np.ascontiguousarray(flat, dtype=np.float64)))
    on_planes = int(np.count_nonzero(number >= 0))
    return PointCounts(
        total=len(flat),
        no_return=len(flat) - n_returns,
        repeated=n_returns - n_used,
        on_planes=on_planes,
        edge_on=edge_on,
        on_no_plane=n_used - on_planes - edge_on,
    )


def _grown(sigma_m: float, grid: FloatArray) -> FloatArray:
    """Standard deviations (S, B) that grow with the depth as a Kinect's, with the median that was measured."""
    sigmas = DepthCameraModel().depth_sigma(grid[..., 2])
    return np.where(np.isfinite(sigmas), sigmas * (sigma_m / np.nanmedian(sigmas)), sigma_m)


def _sigma_of(grid: FloatArray) -> tuple[float, str]:
    scatter = scatter_of(grid)
    if scatter is None:
        return ASSUMED_SIGMA_M, "assumed: too few neighbours in the cloud to measure it; give --sigma"
    if scatter.surface_m < _LEAST_SIGMA_M:
        return _LEAST_SIGMA_M, "the least there is: the cloud shows no noise"
    beam, surface = 1000.0 * scatter.beam_m, 1000.0 * scatter.surface_m
    return scatter.surface_m, (
        f"measured: ranges of neighbouring beams scatter by {beam:.2g} mm, with what beams share by {surface:.2g} mm"
    )
