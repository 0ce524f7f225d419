"""The floor plan of a building: rooms, walls and openings of every storey, each measure with its standard deviation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import shapely

from slam.floorplan.faces import ALIKE_RAD, SHORT_M, Face, Interval, closed
from slam.floorplan.quantities import JointPlanes, Quantity, area, corner, length
from slam.floorplan.rooms import room_rings
from slam.floorplan.storeys import Storey, storeys
from slam.floorplan.walls import Opening, Wall, find_openings, wall_solids, without
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Side:
    """A side of a room: a wall face from corner to corner, the room on the left; corners (3,), m."""

    face: Face
    start: FloatArray
    end: FloatArray
    length: Quantity


@dataclass(frozen=True, eq=False)
class Width:
    """How far two sides of a room that face each other are apart in its middle, from a point (3,) to another one, m."""

    first: FloatArray
    second: FloatArray
    distance: Quantity


@dataclass(frozen=True, eq=False)
class Room:
    """A closed polygon of wall faces."""

    rings: tuple[tuple[Side, ...], ...]
    """Its sides in order, room on the left; the first ring goes round it, others round what stands in it."""
    middle: FloatArray
    """A point inside, its centroid where that is inside, shape (3,), in the section, m."""
    area: Quantity
    """Between the faces, at the height of the section, m^2."""
    widths: tuple[Width, ...]
    """Between facing sides that are met from the middle."""
    height: Quantity | None
    """From floor to ceiling at the middle, m; None where one of them was not seen."""

    @property
    def outline(self) -> tuple[FloatArray, ...]:
        """Corners of each ring, shape (N, 3), m."""
        return tuple(np.array([side.start for side in ring]) for ring in self.rings)

    @property
    def sides(self) -> list[Side]:
        """Those of all rings."""
        return [side for ring in self.rings for side in ring]


@dataclass(frozen=True, eq=False)
class StoreyPlan:
    """The plan of a storey."""

    storey: Storey
    elevation: Quantity | None
    """Height of its floor above the lowest storey's, m; None without a floor."""
    rooms: tuple[Room, ...]
    """Closed rooms, the largest first."""
    walls: tuple[Wall, ...]
    """Where both faces were seen."""
    single: tuple[tuple[Face, Interval], ...]
    """Stretches of faces whose other side was not seen: how thick the wall is there is not known."""
    openings: tuple[Opening, ...]


@dataclass(frozen=True, eq=False)
class FloorPlan:
    """A building."""

    joint: JointPlanes
    storeys: tuple[StoreyPlan, ...]
    """From below."""

    @property
    def warnings(self) -> list[str]:
        """What whoever expects rooms must know, one sentence each."""
        if any(storey.rooms for storey in self.storeys):
            return []
        return ["the floor plan has no rooms: none was seen all round, only walls and openings are drawn"]


def floor_plan(joint: JointPlanes) -> FloorPlan:
    """The floor plan of a map; ValueError: no vertical plane was seen that is long enough and reaches the ceiling."""
    levels = [storey for storey in storeys(joint) if storey.faces]
    if not levels:
        raise ValueError("planes: expected at least one vertical plane for a floor plan, got none")
    plans = tuple(_plan_of(storey, levels[0].section.floor) for storey in levels)
    drawn = tuple(plan for plan in plans if plan.rooms or plan.walls or plan.single or plan.openings)
    if not drawn:
        raise ValueError("planes: expected a wall that reaches the ceiling for a floor plan, got none")
    return FloorPlan(joint, drawn)


def _plan_of(storey: Storey, lowest: int | None) -> StoreyPlan:
    faces = storey.walls()
    rooms = [_room(storey, rings) for rings in room_rings(storey, faces)]
    rooms.sort(key=lambda one: -one.area.value)
    extents = [(face, _extent(face, rooms)) for face in faces]
    walls = wall_solids(storey, extents)
    single = [(face, span) for face, spans in extents for span in _unpaired(face, spans, walls)]
    openings = find_openings(storey, faces, walls)
    floor, elevation = storey.section.floor, None
    if floor is not None:
        elevation = storey.rise(lowest, floor, storey.joint.planes[floor].plane.centre)
    return StoreyPlan(storey, elevation, tuple(rooms), tuple(walls), tuple(single), tuple(openings))


def _room(storey: Storey, rings: list[list[Face]]) -> Room:
    joint, corners, sides = storey.joint, [], []
    for ring in rings:
        ends = [corner(joint.hesse, ring[k - 1].plane, face.plane, storey.section) for k, face in enumerate(ring)]
        along = zip(ring, ends, [*ends[1:], ends[0]], strict=True)
        sides.append(tuple(Side(face, a.point, b.point, joint.quantity(*length(a, b))) for face, a, b in along))
        corners.append(ends)
    outline = [storey.in_plan(np.array([end.point for end in ends])) for ends in corners]
    shape = shapely.Polygon(outline[0], outline[1:])
    place = shape.centroid if shape.contains(shape.centroid) else shape.representative_point()
    middle = storey.plan @ np.array(place.coords[0])
    middle += (storey.section.d - storey.section.normal @ middle) * storey.section.normal
    widths = tuple(_widths(joint, [side for ring in sides for side in ring], middle))
    below, above = (storey.over(shape.buffer(0.0), levels) for levels in (storey.floors, storey.ceilings))
    height = None if below is None or above is None else storey.rise(below.plane, above.plane, middle)
    return Room(tuple(sides), middle, joint.quantity(*area(corners, storey.section)), widths, height)


def _widths(joint: JointPlanes, sides: Sequence[Side], middle: FloatArray) -> list[Width]:
    found = []
    for one, other in combinations(sides, 2):
        if one.face.normal @ other.face.normal > -np.cos(ALIKE_RAD):
            continue
        direction = (one.face.normal - other.face.normal) / np.linalg.norm(one.face.normal - other.face.normal)
        ends = [middle - one.face.before(middle) * direction, middle + other.face.before(middle) * direction]
        if all(_is_on(side, end) for side, end in zip((one, other), ends, strict=True)):
            value = joint.between(one.face.plane, other.face.plane, middle, direction)
            found.append(Width(ends[0], ends[1], value))
    return found


def _is_on(side: Side, point: FloatArray) -> bool:
    way = side.end - side.start
    return 0.0 <= float((point - side.start) @ way) <= float(way @ way)


def _extent(face: Face, rooms: Sequence[Room]) -> list[Interval]:
    """From where to where a face goes: to the corners of the rooms that it is a side of, and as it was seen elsewhere.

    What was seen beyond the last corner by no more than outlines are rough is of the corner.
    """
    sides = [side for room in rooms for side in room.sides if side.face is face]
    ways = [face.s_of(np.array([side.start, side.end])).tolist() for side in sides]
    known: list[Interval] = [(min(way), max(way)) for way in ways]
    ends = {end for span in known for end in span}
    beyond = [s for s in without(face.covered, known) if s[1] - s[0] > SHORT_M or (s[0] in ends and s[1] in ends)]
    return closed([*known, *beyond], 0.0)


def _unpaired(face: Face, spans: list[Interval], walls: Sequence[Wall]) -> list[Interval]:
    taken = [wall.span for wall in walls if wall.front is face]
    taken += [face.beside(wall.front, wall.span) for wall in walls if wall.back is face]
    return [span for span in without(spans, taken) if span[1] - span[0] > SHORT_M]
