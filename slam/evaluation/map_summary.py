"""What a map says in numbers: which planes face each other, how far apart, how parallel, how sure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import shapely
import shapely.ops
from shapely.geometry.base import BaseGeometry

from slam.geometry.frames import inverse, lift
from slam.geometry.polygons import flatten, valid
from slam.map.map_planes import MapPlane
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
    """Distance along the mean normal where, of all places in which they face each other, it is known best, m."""
    sigma_m: float
    """Its standard deviation from the two planes' covariances taken as independent, m."""
    angle_deg: float
    """Angle between one normal and the other's opposite, deg."""
    overlap_m2: float
    """Area in which they face each other, m^2."""


def facing_pairs(planes: Sequence[MapPlane], *, min_overlap_m2: float = 0.5) -> list[FacingPair]:
    """Pairs of facing planes that overlap, seen along their normal, by at least so much; the largest overlap first."""
    pairs = (pair for two in combinations(planes, 2) if (pair := _pair(*two)) is not None)
    wide = [pair for pair in pairs if pair.overlap_m2 >= min_overlap_m2]
    return sorted(wide, key=lambda pair: (-pair.overlap_m2, pair.first, pair.second))


def _pair(first: MapPlane, second: MapPlane) -> FacingPair | None:
    a, b = first.plane, second.plane
    cosine = float(a.normal @ -b.normal)
    if cosine < np.cos(_FACING_ANGLE_RAD) or a.distance(b.centre) <= 0.0:
        return None
    moved = flatten(second.seen, inverse(a.frame) @ b.frame)
    shared = shapely.intersection(valid(first.seen), valid(moved))
    if shared.area <= 0.0:
        return None
    place = _surest_place(a, b, shared)
    foot = a.frame[:3, :3] @ np.array([place.x, place.y, 0.0]) + a.frame[:3, 3]
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


def _surest_place(a: Plane, b: Plane, shared: BaseGeometry) -> shapely.Point:
    """Where in `shared`, in (x, y) of a's frame, the gap between two planes has the least variance.

    A plane's height at (x, y) is h.p with h = (1, -x, y) = first + slope (x, y), so the sum of both variances is a
    quadratic form in (x, y); off `shared` its minimum is moved to the nearest point there.
    """
    b_T_a = inverse(b.frame) @ a.frame
    first, slope = np.array([1.0, 0.0, 0.0]), np.array([[0.0, 0.0], [-1.0, 0.0], [0.0, 1.0]])
    first_b, slope_b = first + slope @ b_T_a[:2, 3], slope @ b_T_a[:2, :2]
    curvature = slope.T @ a.covariance @ slope + slope_b.T @ b.covariance @ slope_b
    pull = slope.T @ a.covariance @ first + slope_b.T @ b.covariance @ first_b
    best = shapely.Point(np.linalg.lstsq(curvature, -pull, rcond=None)[0])
    return shapely.ops.nearest_points(shared, best)[0]


def _variance_at(plane: Plane, point: FloatArray) -> float:
    """Variance of a plane's height at a point on it."""
    frame, covariance = plane.frame, plane.covariance
    x, y = (point - frame[:3, 3]) @ frame[:3, :2]
    slope = np.array([1.0, -x, y])
    return float(slope @ covariance @ slope)


#: Walls lean less than this from the vertical: sine.
_MAX_LEAN = 0.26
#: Walls nearer to each other than this, over one place of the plan, are counted as one metre of wall, m.
_SAME_M = 0.3


def metres_of_wall(planes: Sequence[MapPlane]) -> tuple[int, float]:
    """Number of walls among planes, and the length of wall that they cover in plan, m, each place once."""
    strips = []
    for plane in planes:
        if abs(float(plane.plane.normal[2])) > _MAX_LEAN:
            continue
        corners = lift(shapely.get_coordinates(plane.seen), plane.plane.frame)[:, :2]
        across = plane.plane.normal[:2] / np.linalg.norm(plane.plane.normal[:2])
        along = corners @ np.array((-across[1], across[0]))
        ends = corners[[int(np.argmin(along)), int(np.argmax(along))]]
        strips.append(shapely.LineString(ends).buffer(0.5 * _SAME_M, cap_style="flat"))
    return len(strips), float(shapely.union_all(strips).area / _SAME_M) if strips else 0.0
