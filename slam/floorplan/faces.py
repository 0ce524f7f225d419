"""Wall faces of a storey: vertical planes as lines in the plan, and which part of each line was seen."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from slam.floorplan.quantities import JointPlanes, Section
from slam.geometry.frames import lift
from slam.geometry.polygons import polygons_of, segments_of, valid
from spplanes._check import FloatArray

#: Planes are level, upright, parallel or facing within this angle, rad: as in slam.evaluation.planes.
ALIKE_RAD = np.deg2rad(5.0)
#: The seen part of a face ends up to here before the face does, m: beams 1 deg apart at 10 m hit a wall 0.17 m apart,
#: at a slant more.
SHORT_M = 0.3

Interval = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Face:
    """A vertical plane in a storey, seen from the side of its normal."""

    plane: int
    origin: FloatArray
    """The point of its line at s = 0, in the section, shape (3,), m."""
    along: FloatArray
    """Unit direction of its line, the seen side on its left, shape (3,)."""
    normal: FloatArray
    """Unit normal of its line in the section, toward the seen side, shape (3,)."""
    seen: BaseGeometry
    """What was seen of it in this storey: (s along the line, z height above the storey's floor), m."""

    @cached_property
    def covered(self) -> list[Interval]:
        """Where along the line it was seen, at any height; gaps no wider than a doorway are closed.

        They are doorways, or something stood before them; DIN 18101 has leaves to 1.235 m.
        """
        return closed(_spans(self.seen, 0), 1.25)

    @cached_property
    def extended(self) -> list[Interval]:
        """`covered`, every end by so much longer as it may have been seen short."""
        return closed([(low - SHORT_M, high + SHORT_M) for low, high in self.covered], 0.0)

    @property
    def top(self) -> float:
        """Height above the floor up to which it was seen, m."""
        return float(self.seen.bounds[3])

    def point(self, s: float) -> FloatArray:
        """The point of its line at s, shape (3,), m."""
        return self.origin + s * self.along

    @property
    def ends(self) -> FloatArray:
        """The first and the last point of its line that anything was seen above or below, shape (2, 3), m."""
        return np.array([self.point(self.seen.bounds[0]), self.point(self.seen.bounds[2])])

    def s_of(self, points: FloatArray) -> FloatArray:
        """Where along its line points (..., 3) are, m."""
        return (points - self.origin) @ self.along

    def beside(self, other: Face, span: Interval) -> Interval:
        """Where along its line a stretch of another face is, m."""
        ends = self.s_of(np.array([other.point(s) for s in span]))
        return float(ends.min()), float(ends.max())

    def before(self, points: FloatArray) -> FloatArray:
        """How far points (..., 3) are on its seen side, m."""
        return (points - self.origin) @ self.normal

    def gaps_at(self, height: float) -> list[Interval]:
        """Where along `covered` nothing was seen of it at a height above the floor, between parts that were, m."""
        level = shapely.LineString([(self.seen.bounds[0], height), (self.seen.bounds[2], height)])
        seen = closed(_spans(shapely.intersection(valid(self.seen), level), 0), 0.0)
        gaps = [(one[1], other[0]) for one, other in pairwise(seen)]
        return [gap for gap in gaps if any(low <= gap[0] and gap[1] <= high for low, high in self.covered)]

    def gap_upright(self, s: float, height: float) -> tuple[float | None, float | None]:
        """Up to where it was seen below a place on it at which it was not, and from where on above; heights, m."""
        line = shapely.LineString([(s, self.seen.bounds[1] - 1.0), (s, self.top + 1.0)])
        seen = closed(_spans(shapely.intersection(valid(self.seen), line), 1), 0.0)
        below, above = [b for _, b in seen if b <= height], [a for a, _ in seen if a >= height]
        return max(below, default=None), min(above, default=None)


def _spans(geometry: BaseGeometry, axis: int) -> list[Interval]:
    """From where to where each polygon and each segment of a geometry goes along x or y."""
    corners = [shapely.get_coordinates(polygon) for polygon in polygons_of(geometry)] + segments_of(geometry)
    return [(float(one[:, axis].min()), float(one[:, axis].max())) for one in corners if len(one)]


def face_of(joint: JointPlanes, plane: int, section: Section, low: float, high: float, floor: float) -> Face | None:
    """A vertical plane, by its index, as a face of a storey; None where nothing of it was seen there.

    The storey is between the heights `low` and `high` along the section's normal, m, its floor at `floor`.
    """
    up, frame = section.normal, joint.planes[plane].plane.frame
    normal = joint.hesse[plane, :3] - (joint.hesse[plane, :3] @ up) * up
    normal /= np.linalg.norm(normal)
    along = np.cross(normal, up)
    middle = frame[:3, 3] + (section.d - up @ frame[:3, 3]) * up  # then along the normal onto the plane
    slope = float(joint.hesse[plane, :3] @ normal)
    origin = middle + (joint.hesse[plane, 3] - joint.hesse[plane, :3] @ middle) / slope * normal

    def unrolled(xy: FloatArray) -> FloatArray:
        points = lift(xy, frame)
        return np.column_stack(((points - origin) @ along, points @ up - floor))

    seen = valid(shapely.transform(valid(joint.planes[plane].seen), unrolled))
    west, bottom, east, top = seen.bounds
    if bottom < low - floor or top > high - floor:  # of a wall through several storeys what is in this one
        box = shapely.box(west - 1.0, max(low - floor, bottom - 1.0), east + 1.0, min(high - floor, top + 1.0))
        seen = shapely.intersection(seen, box)
        if seen.is_empty or seen.bounds[3] - seen.bounds[1] < min(SHORT_M, top - bottom):
            return None
    return None if seen.is_empty or seen.length == 0.0 else Face(plane, origin, along, normal, seen)


def closed(intervals: list[Interval], gap: float) -> list[Interval]:
    """Disjoint intervals in order, those no further apart than a gap joined."""
    joined: list[Interval] = []
    for low, high in sorted(intervals):
        if joined and low - joined[-1][1] <= gap:
            joined[-1] = (joined[-1][0], max(joined[-1][1], high))
        else:
            joined.append((low, high))
    return joined


def shared(first: list[Interval], second: list[Interval]) -> list[Interval]:
    """Where both are."""
    parts = [(max(a, c), min(b, d)) for a, b in first for c, d in second]
    return [part for part in sorted(parts) if part[1] > part[0]]


def covered_length(intervals: list[Interval], low: float, high: float) -> float:
    """How much of an interval some others cover, m."""
    return sum(b - a for a, b in shared(intervals, [(low, high)]))
