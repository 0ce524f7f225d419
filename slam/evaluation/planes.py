"""Estimated planes against true planes: who is whom, how far off, what is double, missing or invented."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from shapely.geometry.base import BaseGeometry

from slam.evaluation.trajectories import Metric
from slam.geometry.frames import inverse
from slam.geometry.polygons import flatten, valid
from spplanes.plane import Plane

#: An estimated plane may be a true one when it is within these of it, rad and m, on the same side ...
ANGLE_GATE_RAD, DISTANCE_GATE_M = np.deg2rad(10.0), 0.15
#: ... and this share of its outline lies on the true one's, or of the true one's on its.
OVERLAP_GATE = 0.3


@dataclass(frozen=True)
class PlaneMatch:
    """An estimated plane and the true plane it is an image of."""

    estimated: int
    """Index of the estimated plane."""
    true: int
    """Index of the true plane."""
    angle_rad: float
    """Angle between the normals, rad."""
    distance_m: float
    """Distance of the estimated plane's centre from the true plane, signed, m."""
    nees: float
    """Squared Mahalanobis distance of the truth by the estimated covariance, chi2 with 3 degrees of freedom."""


def match_planes(estimated: Sequence[Plane], true: Sequence[Plane]) -> list[PlaneMatch]:
    """Match every estimated plane to the true plane it lies on; several may match one (duplicates).

    Both are in the same frame. Candidates are near in angle and distance, face the same side and overlap; of those the
    nearest wins, measured over the estimated outline (a locker's front is not the wall behind it).
    """
    return [match for index, plane in enumerate(estimated) if (match := _match_one(index, plane, true)) is not None]


def _match_one(index: int, plane: Plane, true: Sequence[Plane]) -> PlaneMatch | None:
    best: tuple[float, int] | None = None
    for candidate, truth in enumerate(true):
        if plane.normal @ truth.normal < np.cos(ANGLE_GATE_RAD) or abs(truth.distance(plane.centre)) > DISTANCE_GATE_M:
            continue
        misfit = _misfit(plane, truth)
        if (best is None or misfit < best[0]) and _overlap(plane, truth) >= OVERLAP_GATE:
            best = (misfit, candidate)
    if best is None:
        return None
    truth = true[best[1]]
    angle = float(np.arctan2(np.linalg.norm(np.cross(plane.normal, truth.normal)), plane.normal @ truth.normal))
    return PlaneMatch(index, best[1], angle, float(truth.distance(plane.centre)), plane.mahalanobis(truth))


def _misfit(plane: Plane, truth: Plane) -> float:
    """Root mean square distance of the estimated outline's corners, or of its centre, from the true plane, m."""
    if plane.outline is None:
        return abs(float(truth.distance(plane.centre)))
    corners = np.array(plane.outline.exterior.coords)[:-1]
    places = plane.centre + corners @ plane.frame[:3, :2].T
    return float(np.sqrt(np.mean(truth.distance(places) ** 2)))


def _overlap(plane: Plane, truth: Plane) -> float:
    """Area common to both outlines as a share of the smaller one; 1 where an outline is missing."""
    if plane.outline is None or truth.outline is None:
        return 1.0
    mine = outline_in(plane, truth)
    smaller = min(mine.area, truth.outline.area)
    return mine.intersection(truth.outline).area / smaller if smaller > 0.0 else 0.0


def outline_in(plane: Plane, other: Plane) -> BaseGeometry:
    """Outline of a plane projected into the plane coordinates of another."""
    assert plane.outline is not None
    return valid(flatten(plane.outline, inverse(other.frame) @ plane.frame))


def plane_metrics(
    estimated: Sequence[Plane], true: Sequence[Plane], *, visible: Collection[int] | None = None
) -> list[Metric]:
    """Errors of matched planes, and shares of duplicates, of missed and of invented ones.

    Args:
        estimated: planes of a map, in the frame of the truth.
        true: the true planes.
        visible: indices of the true planes that the sensors saw enough of to be found; None: all.
    """
    matches = match_planes(estimated, true)
    wanted = set(range(len(true))) if visible is None else set(visible)
    hit = {match.true for match in matches}
    angles = np.rad2deg([match.angle_rad for match in matches])
    distances = np.abs([match.distance_m for match in matches])
    return [
        Metric("planes estimated", len(estimated), ""),
        Metric("planes true", len(wanted), ""),
        Metric("planes missed", 100.0 * _share(len(wanted - hit), len(wanted)), "%"),
        Metric("planes duplicate", 100.0 * _share(len(matches) - len(hit), len(matches)), "%"),
        Metric("planes invented", 100.0 * _share(len(estimated) - len(matches), len(estimated)), "%"),
        Metric("plane angle median", float(np.median(angles)) if matches else float("nan"), "deg"),
        Metric("plane angle max", float(angles.max(initial=0.0)) if matches else float("nan"), "deg"),
        Metric("plane distance median", float(np.median(distances)) if matches else float("nan"), "m"),
        Metric("plane distance max", float(distances.max(initial=0.0)) if matches else float("nan"), "m"),
        Metric("plane NEES mean", float(np.mean([m.nees for m in matches])) if matches else float("nan"), ""),
    ]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")
