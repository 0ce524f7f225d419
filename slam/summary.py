"""What a map says in numbers: which planes face each other, how far apart, how parallel, how sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from slam.frames import inverse
from slam.outlines import flatten, valid
from slam.planeslam import MapPlane
from spplanes import Plane
from spplanes._check import FloatArray

#: Planes whose normals are within this of opposite are compared, rad.
_FACING_ANGLE_RAD = np.deg2rad(5.0)
#: A normal this near to the vertical makes floor and ceiling rather than walls.
_VERTICAL_COSINE = np.cos(np.deg2rad(30.0))


@dataclass(frozen=True)
class FacingPair:
    """Two planes of the map that look at each other: floor and ceiling, or two walls."""

    name: str
    """height (of a room) or width."""
    first: int
    """Landmark id."""
    second: int
    """Landmark id."""
    distance_m: float
    """Distance along the mean normal, half way between what was seen of them, m."""
    sigma_m: float
    """Its standard deviation from the two planes' covariances taken as independent, m."""
    angle_deg: float
    """Angle between one normal and the other's opposite, deg."""
    overlap_m2: float
    """Area in which they face each other, m^2."""


def facing_pairs(planes: Sequence[MapPlane], *, min_overlap_m2: float = 0.5) -> list[FacingPair]:
    """Pairs of facing planes that overlap, seen along their normal, by at least so much; the largest overlap first."""
    pairs = []
    for index, first in enumerate(planes):
        for second in planes[index + 1 :]:
            pair = _pair(first, second)
            if pair is not None and pair.overlap_m2 >= min_overlap_m2:
                pairs.append(pair)
    return sorted(pairs, key=lambda pair: (-pair.overlap_m2, pair.first, pair.second))


def _pair(first: MapPlane, second: MapPlane) -> FacingPair | None:
    a, b = first.plane, second.plane
    cosine = float(a.normal @ -b.normal)
    if cosine < np.cos(_FACING_ANGLE_RAD) or a.distance(b.centre) <= 0.0:
        return None
    moved = flatten(second.seen, inverse(a.frame) @ b.frame)
    shared = shapely.intersection(valid(first.seen), valid(moved))
    if shared.area <= 0.0:
        return None
    overlap = shared.centroid
    foot = a.frame[:3, :3] @ np.array([overlap.x, overlap.y, 0.0]) + a.frame[:3, 3]
    direction = (a.normal - b.normal) / np.linalg.norm(a.normal - b.normal)
    gap = float(-b.distance(foot) / (b.normal @ direction))
    sigma = float(np.sqrt(_variance_at(a, foot) + _variance_at(b, b.project(foot))))
    name = "height" if abs(direction[2]) > _VERTICAL_COSINE else "width"
    return FacingPair(
        name=name,
        first=first.id,
        second=second.id,
        distance_m=abs(gap),
        sigma_m=sigma,
        angle_deg=float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        overlap_m2=float(shared.area),
    )


def _variance_at(plane: Plane, point: FloatArray) -> float:
    """Variance of a plane's height at a point on it."""
    frame, covariance = plane.frame, plane.covariance
    x, y = (point - frame[:3, 3]) @ frame[:3, :2]
    slope = np.array([1.0, -x, y])
    return float(slope @ covariance @ slope)
