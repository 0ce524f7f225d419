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
from spplanes import Plane, segment_cloud
from spplanes._check import FloatArray
from spplanes.segmentation.cloud import CloudPlanes

#: What is taken where neither the caller nor the cloud says how its points scatter, m.
ASSUMED_SIGMA_M = 0.01


@dataclass(frozen=True)
class PointCounts:
    """Every point of a cloud, counted once."""

    total: int
    no_return: int
    """Not finite, or at the sensor."""
    repeated: int
    """The same as another point, to the last bit."""
    on_planes: int
    edge_on: int
    """On planes flagged as seen edge-on from the viewpoint: a line of the scan, not a surface."""
    on_no_plane: int
    """On nothing that is one, or on planes of fewer points than asked for."""

    @property
    def returns(self) -> int:
        """Points that are looked at."""
        return self.total - self.no_return - self.repeated


@dataclass(frozen=True, eq=False)
class FittedCloud:
    """The planes of a cloud."""

    planes: list[Plane]
    """In the frame of the file, those with most points first."""
    flags: list[str]
    """Of every plane: "", "edge-on" or "too near"."""
    points: FloatArray
    """The returns in that frame, shape (N, 3), m."""
    labels: np.ndarray
    """Plane of every return, shape (N,), index into planes; -1: none."""
    sigma_m: float
    """Standard deviation of the points about their planes, m."""
    octave_sigma_m: float
    """Standard deviation of an octave of the error that neighbouring points share, m."""
    note: str
    """Where these come from, one sentence."""
    viewpoint: FloatArray
    """Where the cloud was seen from, in that frame, shape (3,), m."""
    counts: PointCounts
    warnings: list[str]
    """What speaks against these planes, a sentence each."""

    @property
    def map_planes(self) -> list[MapPlane]:
        """The planes as those of a map of one scan."""
        return [
            MapPlane(index, plane, plane.outline or shapely.Polygon(), 1, ("scan",))
            for index, plane in enumerate(self.planes)
        ]

    def at_least(self, n_points: int) -> FittedCloud:
        """Only the planes of so many points; they come first."""
        kept = sum(plane.n_points >= n_points for plane in self.planes)
        labels, flags = np.where(self.labels < kept, self.labels, -1), self.flags[:kept]
        counts = _counted(self.counts, self.planes[:kept], flags)
        return replace(self, planes=self.planes[:kept], flags=flags, labels=labels, counts=counts)

    def table(self) -> list[dict[str, Any]]:
        """The planes in plain numbers: d with its standard deviation at the centre, the worse of the two tilts."""
        rows = []
        for index, (plane, flag) in enumerate(zip(self.planes, self.flags, strict=True)):
            sigma, *tilts = np.sqrt(np.diag(plane.covariance)).tolist()
            tilt, area = math.degrees(max(tilts)), 0.0 if plane.outline is None else plane.outline.area
            where = {"normal": plane.normal.tolist(), "d": plane.d, "sigma_d_m": sigma, "sigma_tilt_deg": tilt}
            rows.append({"id": index, **where, "n_points": plane.n_points, "area_m2": area, "flag": flag})
        return rows


def fit_cloud(
    cloud: Cloud, source: Path, *, sigma_m: float | None = None, viewpoint: Sequence[float] = (0.0, 0.0, 0.0)
) -> FittedCloud:
    """Find the planes of a cloud in its sensor's frame, as `segment_cloud` does; LogError: no three points.

    The points scatter by `sigma_m`, at least; None: by what the cloud shows. A cloud in another frame than the sensor's
    was seen from `viewpoint`, m: normals point there.
    """
    if sum(np.isfinite(cloud.points[..., 0]).ravel()) < 3:
        raise LogError(source, "expected at least three points, got fewer")
    found, note = _segmented(cloud.points, sigma_m, viewpoint)
    back = np.eye(4) if cloud.world_T_sensor is None else cloud.world_T_sensor
    flat, labels = cloud.points.reshape(-1, 3), found.labels.ravel()
    seen = np.isfinite(flat).all(axis=1) & (flat != np.asarray(viewpoint)).any(axis=1)
    points = flat[seen] @ back[:3, :3].T + back[:3, 3]
    eye = back[:3, :3] @ np.asarray(viewpoint, dtype=np.float64) + back[:3, 3]
    coverage, noise = found.coverage, (found.noise.sigma_m, found.noise.octave_sigma_m)
    counts = PointCounts(coverage.total, coverage.no_return, coverage.repeated, 0, 0, 0)
    counts = _counted(counts, found.planes, found.flags)
    planes = [plane.transform(back) for plane in found.planes]
    return FittedCloud(planes, found.flags, points, labels[seen], *noise, note, eye, counts, found.warnings)


def _segmented(points: FloatArray, sigma_m: float | None, viewpoint: Sequence[float]) -> tuple[CloudPlanes, str]:
    try:
        found = segment_cloud(points, sigma=sigma_m, viewpoint=viewpoint)
    except ValueError as error:
        if sigma_m is not None or not str(error).startswith("sigma:"):
            raise
        found = segment_cloud(points, sigma=ASSUMED_SIGMA_M, viewpoint=viewpoint)
        return found, "assumed: the cloud shows no flat places to measure it at; give --sigma"
    return found, found.noise.source


def _counted(counts: PointCounts, planes: Sequence[Plane], flags: Sequence[str]) -> PointCounts:
    edge_on = sum(plane.n_points for plane, flag in zip(planes, flags, strict=True) if flag == "edge-on")
    on_planes = sum(plane.n_points for plane in planes) - edge_on
    rest = counts.returns - on_planes - edge_on
    return replace(counts, on_planes=on_planes, edge_on=edge_on, on_no_plane=rest)
