"""Storeys: level planes told apart by height, and the wall faces between a floor and what is above it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from slam.floorplan.faces import ALIKE_RAD, SHORT_M, Face, Interval, face_of
from slam.floorplan.quantities import JointPlanes, Quantity, Section
from slam.geometry.frames import lift
from slam.geometry.polygons import valid
from slam.map.map_planes import MapPlane
from spplanes._check import FloatArray

#: Floors are at least this far apart, m: what is level and lower is a table or a step. No room is lower.
STOREY_M = 2.0


@dataclass(frozen=True, eq=False)
class Level:
    """A level plane."""

    plane: int
    height: float
    """Along the upward normal, m."""
    outline: BaseGeometry
    """What was seen of it, in (x, y) of the plan, m."""


@dataclass(frozen=True, eq=False)
class Storey:
    """What was seen between one floor and the next."""

    joint: JointPlanes
    section: Section
    plan: FloatArray
    """x and y axis of the plan, columns, shape (3, 2)."""
    floor_height: float
    """Height of the floor along the upward normal, m; of a storey without a floor 0."""
    floors: tuple[Level, ...]
    """Level planes seen from above: floors, tables, sills, the largest first."""
    ceilings: tuple[Level, ...]
    """Level planes seen from below: ceilings, lintels, the largest first."""
    faces: tuple[Face, ...]
    """All vertical planes of it."""

    def in_plan(self, points: FloatArray) -> FloatArray:
        """Points (..., 3) as (x, y) of the plan, m."""
        return points @ self.plan

    def over(self, outline: BaseGeometry, levels: tuple[Level, ...]) -> Level | None:
        """The level plane that covers most of a piece of the plan; None where none covers any of it."""
        areas = [shapely.intersection(outline, level.outline).area for level in levels]
        best = int(np.argmax(areas)) if areas else -1
        return levels[best] if areas and areas[best] > 0.0 else None

    def rise(self, first: int | None, second: int | None, place: FloatArray) -> Quantity | None:
        """How far a plane is above another one at a place (3,); None where one of them was not seen."""
        if first is None or second is None:
            return None
        return self.joint.between(first, second, place, self.section.normal)

    def walls(self) -> list[Face]:
        """The faces that reach the ceiling before them; where no ceiling was seen, all."""
        return [face for face in self.faces if self._reaches_ceiling(face)]

    def _reaches_ceiling(self, face: Face) -> bool:
        ends = self.in_plan(face.ends)
        before = ends + SHORT_M * self.in_plan(face.normal)
        strip = shapely.Polygon([*ends, before[1], before[0]])
        above = self.over(strip, self.ceilings) or next(iter(self.ceilings), None)
        return above is None or face.top >= above.height - self.floor_height - SHORT_M


def storeys(joint: JointPlanes) -> list[Storey]:
    """The storeys of a building, from below; one without a floor where no level plane was seen from above."""
    up = upward(joint.hesse[:, :3], joint.planes)
    up = np.array([0.0, 0.0, 1.0]) if up is None else up
    floors, ceilings = (_levels(joint, up, side) for side in (up, -up))
    grounds = _grounds(floors)
    between = pairwise([-np.inf, *(ground.height for ground in grounds[1:]), np.inf])
    pairs = zip(grounds or [None], between, strict=True)
    return [_storey(joint, up, ground, heights, floors, ceilings) for ground, heights in pairs]


def upward(normals: FloatArray, planes: Sequence[MapPlane]) -> FloatArray | None:
    """Of planes with normals (P, 3) the largest floor's, (3,), within 30 deg of the world's z; None: no floor."""
    floors = [k for k in range(len(planes)) if normals[k, 2] > np.cos(np.deg2rad(30.0))]
    return normals[max(floors, key=lambda k: planes[k].seen.area)] if floors else None


def plan_axes(up: FloatArray) -> FloatArray:
    """x and y axis of the plan, columns, shape (3, 2): x goes where the world's does, seen from above."""
    x = np.array([1.0, 0.0, 0.0]) - up[0] * up
    x /= np.linalg.norm(x)
    return np.column_stack((x, np.cross(up, x))).astype(np.float64)


def _levels(joint: JointPlanes, up: FloatArray, side: FloatArray) -> list[Level]:
    """The level planes seen from above or below, `side` (3,), the largest first."""
    plan, levels = plan_axes(up), []
    for plane in np.flatnonzero(joint.hesse[:, :3] @ side > np.cos(ALIKE_RAD)).tolist():
        frame, seen = joint.planes[plane].plane.frame, valid(joint.planes[plane].seen)
        outline = valid(shapely.transform(seen, lambda xy, frame=frame: lift(xy, frame) @ plan))
        middle = lift(np.array(seen.centroid.coords), frame)[0]
        levels.append(Level(plane, float(middle @ up), outline))
    return sorted(levels, key=lambda one: -one.outline.area)


def _grounds(floors: list[Level]) -> list[Level]:
    """The floor of every storey, from below: the largest, then the next that is not in a storey of one before it."""
    chosen: list[Level] = []
    for one in floors:
        if all(abs(one.height - other.height) > STOREY_M for other in chosen):
            chosen.append(one)
    return sorted(chosen, key=lambda one: one.height)


def _storey(
    joint: JointPlanes,
    up: FloatArray,
    ground: Level | None,
    between: Interval,
    floors: list[Level],
    ceilings: list[Level],
) -> Storey:
    """The storey on a ground, or of no floor, with what is between two heights, m."""
    low, high = between
    floor = 0.0 if ground is None else ground.height
    upright = [k for k in range(len(joint.planes)) if abs(joint.hesse[k, :3] @ up) < np.sin(ALIKE_RAD)]

    def faces_in(section: Section) -> tuple[Face, ...]:
        found = (face_of(joint, k, section, low, high, floor) for k in upright)
        return tuple(face for face in found if face is not None)

    seen = [face.seen for face in faces_in(Section(up, floor, None))]
    heights = [(one.centroid.y, max(one.area, 1e-6 * one.length)) for one in seen]
    middle = sum(z * w for z, w in heights) / sum(w for _, w in heights) if heights else 0.0
    section = Section(up, floor + middle, None)
    if ground is not None:
        normal, d = joint.hesse[ground.plane, :3], float(joint.hesse[ground.plane, 3])
        section = Section(normal, d + middle, ground.plane)
    below = tuple(one for one in floors if low <= one.height < high - STOREY_M / 2.0)
    above = tuple(one for one in ceilings if low < one.height <= high)
    return Storey(joint, section, plan_axes(up), floor, below, above, faces_in(section))
