"""Corners, lengths, distances and areas between planes, with their derivatives by the planes' (normal, d).

A corner is where two walls meet the section, a plane at a fixed height above the floor: no frame of the world comes in,
so what the world's origin and orientation are uncertain by does not either. The joint covariance of all planes makes
standard deviations of the derivatives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.backend.estimator import Backend
from slam.map.landmarks import LandmarkMap
from slam.map.map_planes import MapPlane
from slam.mapping.same_plane import hesse_of
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Quantity:
    """A measured number: a length in m, or an area in m^2."""

    value: float
    sigma: float
    """Its standard deviation."""
    gradient: FloatArray
    """Its derivative by (normal, d) of every plane, shape (P, 4)."""

    def __str__(self) -> str:
        """As 2.388 +- 0.004: the standard deviation with one digit, or two where the first is a 1, at most to 1 um."""
        if not self.sigma >= 0.5e-6:
            return f"{self.value:.6f} +- {self.sigma:.6f}"
        size = int(np.floor(np.log10(self.sigma)))
        digits = int(np.clip(-size + (self.sigma < 2.0 * 10.0**size), 0, 6))
        return f"{self.value:.{digits}f} +- {self.sigma:.{digits}f}"


@dataclass(frozen=True, eq=False)
class Section:
    """The plane that a floor plan is cut by."""

    normal: FloatArray
    """Upward unit normal, shape (3,)."""
    d: float
    """Hesse distance, m."""
    floor: int | None
    """The plane that it is parallel to, at a fixed height; None: it is fixed in the world."""


@dataclass(frozen=True, eq=False)
class Corner:
    """A point (3,), m, with its derivatives (P, 3, 4) by (normal, d) of every plane."""

    point: FloatArray
    by: FloatArray


def corner(hesse: FloatArray, first: int, second: int, section: Section) -> Corner:
    """Where two planes meet a section.

    With the three normals as rows of M and M x = d: d x = M^-1 (d d - [x.d n]), so a plane's column of M^-1 times
    (-x, 1) is the derivative by its (normal, d). The two are indices into the rows (normal, d) of all planes, (P, 4).
    """
    matrix = np.vstack((hesse[[first, second], :3], section.normal))
    inverse = np.linalg.inv(matrix)
    point: FloatArray = np.asarray(inverse @ np.append(hesse[[first, second], 3], section.d), dtype=np.float64)
    by = np.zeros((len(hesse), 3, 4))
    for plane, column in zip((first, second, section.floor), inverse.T, strict=True):
        if plane is not None:
            by[plane] = np.outer(column, np.append(-point, 1.0))
    return Corner(point, by)


def length(a: Corner, b: Corner) -> tuple[float, FloatArray]:
    """Distance of two corners and its derivatives."""
    way = b.point - a.point
    distance = float(np.linalg.norm(way))
    unit = way / distance
    return distance, unit @ b.by - unit @ a.by


def area(rings: Sequence[Sequence[Corner]], section: Section) -> tuple[float, FloatArray]:
    """Area of a polygon in the section, outer ring anticlockwise, holes clockwise, and its derivatives.

    The shoelace formula as vector area: A = 1/2 sum n.(x_k x x_k+1), d A / d x_k = 1/2 (x_k+1 - x_k-1) x n. A turn of n
    changes nothing to first order: the vector area is parallel to it.
    """
    total, parts = 0.0, []
    for ring in rings:
        points = np.array([one.point for one in ring])
        following, before = np.roll(points, -1, axis=0), np.roll(points, 1, axis=0)
        total += 0.5 * float(np.cross(points - points[0], following - points[0]).sum(axis=0) @ section.normal)
        by_corners = 0.5 * np.cross(following - before, section.normal)
        parts += [by_corner @ one.by for one, by_corner in zip(ring, by_corners, strict=True)]
    return total, np.sum(parts, axis=0)


def distance(
    hesse: FloatArray, first: int, second: int, place: FloatArray, direction: FloatArray
) -> tuple[float, FloatArray]:
    """How far it is from one plane to another through a place, along a fixed direction, and its derivatives.

    Of two planes that are nearly parallel it depends on place (3,), m, and direction, a unit vector (3,) from the first
    to the second, in second order only. The planes are indices into the rows (normal, d) of all, shape (P, 4).
    """
    ends, gradient = [], np.zeros_like(hesse)
    for plane, sign in ((first, -1.0), (second, 1.0)):
        normal, d = hesse[plane, :3], hesse[plane, 3]
        slope = float(normal @ direction)
        ends.append(float((d - normal @ place) / slope))
        gradient[plane] += sign / slope * np.append(-(place + ends[-1] * direction), 1.0)
    return ends[1] - ends[0], gradient


@dataclass(frozen=True, eq=False)
class JointPlanes:
    """Planes n.x = d of one world, and how their errors hang together."""

    planes: tuple[MapPlane, ...]
    """The planes with what was seen of them; elsewhere each goes by its index here."""
    hesse: FloatArray
    """Rows (normal, d), shape (P, 4), the normal toward the side it was seen from."""
    covariance: FloatArray
    """Of all rows of `hesse` stacked, shape (4 P, 4 P); singular, for every normal keeps its length."""

    def quantity(self, value: float, gradient: FloatArray) -> Quantity:
        """A number that depends on planes, with its standard deviation to first order."""
        row = gradient.ravel()
        return Quantity(value, float(np.sqrt(max(row @ self.covariance @ row, 0.0))), gradient)

    def between(self, first: int, second: int, place: FloatArray, direction: FloatArray) -> Quantity:
        """How far it is from one plane to another, as `distance` has it."""
        return self.quantity(*distance(self.hesse, first, second, place, direction))

    def covariance_of(self, quantities: Sequence[Quantity]) -> FloatArray:
        """Joint covariance (Q, Q) of several quantities, to first order."""
        jacobian = np.array([one.gradient for one in quantities]).reshape(-1, self.hesse.size)
        return jacobian @ self.covariance @ jacobian.T


def joint_planes(planes: Sequence[MapPlane], landmarks: LandmarkMap, backend: Backend) -> JointPlanes:
    """The planes of a map, as `PlaneSlam.planes` has them, with the joint marginal of landmarks and anchor poses."""
    known = [hesse_of(landmarks[plane.id], backend) for plane in planes]
    keys = list(dict.fromkeys(key for _, _, _, by in known for key in by))
    if not keys:
        return JointPlanes((), np.empty((0, 4)), np.empty((0, 0)))
    joint = backend.read_joint_covariance(keys)
    jacobian = np.zeros((4 * len(known), len(joint.full)))
    for row, (_, _, block, by) in enumerate(known):
        jacobian[4 * row : 4 * row + 4, joint.columns(by)] = block
    covariance = jacobian @ joint.full @ jacobian.T
    hesse = np.array([[*normal, d] for normal, d, _, _ in known])
    return JointPlanes(tuple(planes), hesse, 0.5 * (covariance + covariance.T))
