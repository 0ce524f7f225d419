"""Planes of one cloud: what `spplanes fit` does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from slam.errors import LogError
from slam.io.clouds import Cloud
from slam.map.map_planes import MapPlane
from spplanes import MapperConfig, Plane, segment_scans
from spplanes._check import FloatArray
from spplanes.clouds.arrange import arrange
from spplanes.clouds.scatter import scatter_of
from spplanes.noise import DepthCameraModel

#: What is taken where neither the caller nor the cloud says how its points scatter, m.
ASSUMED_SIGMA_M = 0.01
#: Clouds without any noise (made, not measured) get this much, m: no covariance is zero.
_LEAST_SIGMA_M = 1e-4


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
        return float((self.labels >= 0).mean())

    def at_least(self, n_points: int) -> CloudPlanes:
        """Only the planes of so many points; they come first."""
        kept = sum(plane.n_points >= n_points for plane in self.planes)
        return replace(self, planes=self.planes[:kept], labels=np.where(self.labels < kept, self.labels, -1))

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
    back = np.eye(4) if cloud.world_T_sensor is None else cloud.world_T_sensor.copy()
    back[:3, 3] += back[:3, :3] @ eye
    order = sorted(range(len(planes)), key=lambda index: (-planes[index].n_points, index))
    rank = np.full(len(planes) + 1, -1)
    rank[order] = np.arange(len(planes))
    seen = np.isfinite(grid[..., 0])
    points = grid[seen] @ back[:3, :3].T + back[:3, 3]
    return CloudPlanes([planes[k].transform(back) for k in order], points, rank[labels[seen]], sigma, note, back[:3, 3])


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
