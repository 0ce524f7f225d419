"""Planes of a map in numbers: against the true ones, and what they say of rooms without knowing any.

Who is whom, how far off, what is double, missing or invented; which planes face each other, how far apart, how sure.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import shapely
import shapely.ops
from shapely.geometry.base import BaseGeometry

from slam.evaluation.trajectories import Metric
from slam.geometry.frames import inverse, lift
from slam.geometry.polygons import flatten, valid
from slam.map.map_planes import MapPlane
from spplanes._check import FloatArray
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
    cosine, matches = np.cos(ANGLE_GATE_RAD), []
    for index, plane in enumerate(estimated):
        near = [
            (_misfit(plane, truth), number)
            for number, truth in enumerate(true)
            if plane.normal @ truth.normal >= cosine and abs(truth.distance(plane.centre)) <= DISTANCE_GATE_M
        ]
        best = next((number for _, number in sorted(near) if _overlap(plane, true[number]) >= OVERLAP_GATE), None)
        if best is not None:
            truth = true[best]
            angle = np.arctan2(np.linalg.norm(np.cross(plane.normal, truth.normal)), plane.normal @ truth.normal)
            off = float(truth.distance(plane.centre))
            matches.append(PlaneMatch(index, best, float(angle), off, plane.mahalanobis(truth)))
    return matches


def _misfit(plane: Plane, truth: Plane) -> float:
    """Root mean square distance of the estimated outline's corners, or of its centre, from the true plane, m."""
    if plane.outline is None:
        return abs(float(truth.distance(plane.centre)))
    corners = lift(shapely.get_coordinates(plane.outline.exterior)[:-1], plane.frame)
    return float(np.sqrt(np.mean(truth.distance(corners) ** 2)))


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
    """Errors of matched planes, in one frame, and shares of duplicates, of missed and of invented ones.

    `visible` are indices of the true planes that the sensors saw enough of to be found; None: all.
    """
    matches = match_planes(estimated, true)
    wanted = set(range(len(true))) if visible is None else set(visible)
    hit = {match.true for match in matches}
    rows = [(np.rad2deg(match.angle_rad), abs(match.distance_m), match.nees) for match in matches]
    angles, distances, nees = np.array(rows or [[np.nan] * 3]).T
    return [
        Metric("planes estimated", len(estimated), ""),
        Metric("planes true", len(wanted), ""),
        Metric("planes missed", 100.0 * _share(len(wanted - hit), len(wanted)), "%"),
        Metric("planes duplicate", 100.0 * _share(len(matches) - len(hit), len(matches)), "%"),
        Metric("planes invented", 100.0 * _share(len(estimated) - len(matches), len(estimated)), "%"),
        Metric("plane angle median", float(np.median(angles)), "deg"),
        Metric("plane angle max", float(angles.max()), "deg"),
        Metric("plane distance median", float(np.median(distances)), "m"),
        Metric("plane distance max", float(distances.max()), "m"),
        Metric("plane NEES mean", float(nees.mean()), ""),
    ]


def _share(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


#: Area in which they face each other, at least, m^2.
_FACING_M2 = 0.5


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


def facing_pairs(planes: Sequence[MapPlane]) -> list[FacingPair]:
    """Pairs of facing planes that overlap, seen along their normal, by `_FACING_M2`; the largest overlap first."""
    pairs = (pair for two in combinations(planes, 2) if (pair := _pair(*two)) is not None)
    wide = [pair for pair in pairs if pair.overlap_m2 >= _FACING_M2]
    return sorted(wide, key=lambda pair: (-pair.overlap_m2, pair.first, pair.second))


def _pair(first: MapPlane, second: MapPlane) -> FacingPair | None:
    a, b = first.plane, second.plane
    cosine = float(a.normal @ -b.normal)
    if cosine < np.cos(np.deg2rad(5.0)) or a.distance(b.centre) <= 0.0:
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
    name = "height" if abs(direction[2]) > np.cos(np.deg2rad(30.0)) else "width"
    angle = float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))
    return FacingPair(name, first.id, second.id, abs(gap), sigma, angle, float(shared.area))


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


#: Walls nearer to each other than this, over one place of the plan, are counted as one metre of wall, m.
_SAME_M = 0.3


def metres_of_wall(planes: Sequence[MapPlane]) -> tuple[int, float]:
    """Number of walls among planes, and the length of wall that they cover in plan, m, each place once."""
    strips = []
    for plane in planes:
        if abs(float(plane.plane.normal[2])) > 0.26:  # walls lean less than 15 deg
            continue
        corners = lift(shapely.get_coordinates(plane.seen), plane.plane.frame)[:, :2]
        across = plane.plane.normal[:2] / np.linalg.norm(plane.plane.normal[:2])
        along = corners @ np.array((-across[1], across[0]))
        ends = corners[[int(np.argmin(along)), int(np.argmax(along))]]
        strips.append(shapely.LineString(ends).buffer(0.5 * _SAME_M, cap_style="flat"))
    return len(strips), float(shapely.union_all(strips).area / _SAME_M) if strips else 0.0
