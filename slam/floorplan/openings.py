"""Openings: gaps in walls between two jambs that were seen, or where both faces of a wall end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from slam.floorplan.faces import ALIKE_RAD, SHORT_M, Face, Interval
from slam.floorplan.joint_planes import JointPlanes
from slam.floorplan.quantities import Quantity, distance
from slam.floorplan.rooms import THICKEST_M
from slam.floorplan.storeys import Level, Storey
from slam.floorplan.walls import Wall
from spplanes._check import FloatArray

#: Height above the floor at which a plan is cut to draw doors and windows, m, as architects do.
CUT_M = 1.0


@dataclass(frozen=True, eq=False)
class Opening:
    """A doorway, a passage or a window in a wall."""

    face: Face
    """The face it is described along."""
    wall: Wall | None
    """The wall it is in; None where only one face of it was seen."""
    span: Interval
    """From where to where along the face, m."""
    width: Quantity | None
    """Between its jambs, m; None where not both were seen, and `span` is as rough as the outline of the face."""
    height: Quantity | None
    """Of its lintel above the floor, m; None where no lintel or no floor was seen."""
    sill: Quantity | None
    """Height of its sill above the floor, m; None where none was seen."""
    seen_from_m: float
    """Height above the floor up to which the face was seen below it, 0 where it was not: as rough as its outline, m."""
    seen_to_m: float | None
    """Height from which on the face was seen above it, as rough; None where it was not."""
    depth_m: float
    """How deep the wall is here: its thickness, or as far as the jambs were seen."""

    @property
    def outline(self) -> FloatArray:
        """Its corners in the section, anticlockwise seen from above, shape (4, 3), m."""
        return _box(self.face, self.span, self.depth_m)


def find_openings(joint: JointPlanes, storey: Storey, faces: Sequence[Face], solids: Sequence[Wall]) -> list[Opening]:
    """The openings of a storey, each once."""
    found: list[Opening] = []
    known: set[tuple[int, int]] = set()
    for face in faces:
        for gap in face.gaps_at(CUT_M):
            jambs = _jambs(storey, face, gap)
            if jambs is not None:
                key = (min(one.plane for one in jambs), max(one.plane for one in jambs))
                if key not in known:
                    known.add(key)
                    found.append(_between(joint, storey, face, jambs, solids))
                continue
            wall = next((one for one in solids if one.front is face and _contains(one, gap)), None)
            both = None if wall is None else _gap_behind(wall, gap)
            if wall is not None and both is not None:
                found.append(_made(joint, storey, face, wall, both, None, wall.thickness.value))
    return found


def _between(
    joint: JointPlanes, storey: Storey, face: Face, jambs: tuple[Face, Face], solids: Sequence[Wall]
) -> Opening:
    """The opening between two jambs."""
    low, high = (float(face.s_of(one.origin)) for one in jambs)
    beside = (one for one in solids if face in (one.front, one.back))
    wall = next((one for one in beside if _contains(one, one.front.beside(face, (low, high)))), None)
    reach = max(-float(face.before(end)) for one in jambs for end in _ends(one))
    depth = wall.thickness.value if wall is not None else reach
    place = face.point(0.5 * (low + high)) - 0.5 * depth * face.normal
    width = joint.quantity(*distance(joint.hesse, jambs[0].plane, jambs[1].plane, place, face.along))
    return _made(joint, storey, face, wall, (low, high), width, depth)


def _made(
    joint: JointPlanes,
    storey: Storey,
    face: Face,
    wall: Wall | None,
    span: Interval,
    width: Quantity | None,
    depth: float,
) -> Opening:
    corners = _box(face, span, depth)
    outline = shapely.Polygon(storey.in_plan(corners))
    middle = corners.mean(axis=0)
    around = outline.buffer(SHORT_M)  # a ceiling or floor that passes over or through the opening goes beyond it
    lintel, sill = (
        storey.over(outline, tuple(one for one in levels if around.covers(one.outline)))
        for levels in (storey.ceilings, storey.floors)
    )
    below, above = face.gap_upright(0.5 * (span[0] + span[1]), CUT_M)
    return Opening(
        face,
        wall,
        span,
        width,
        _height(joint, storey, lintel, middle),
        _height(joint, storey, sill, middle),
        max(below or 0.0, 0.0),
        above,
        depth,
    )


def _height(joint: JointPlanes, storey: Storey, level: Level | None, middle: FloatArray) -> Quantity | None:
    """Of a level plane above the floor; None where one of them was not seen, or they are the same."""
    floor = storey.section.floor
    if level is None or floor is None or level.plane == floor:
        return None
    return joint.quantity(*distance(joint.hesse, floor, level.plane, middle, storey.section.normal))


def _jambs(storey: Storey, face: Face, gap: Interval) -> tuple[Face, Face] | None:
    """The two faces that look at each other across a gap, from inside the wall behind the face."""
    sides: list[Face] = []
    for s, sign in ((gap[0], 1.0), (gap[1], -1.0)):
        here = [one for one in storey.faces if one is not face and _is_jamb(one, face, s, sign)]
        if not here:
            return None
        sides.append(min(here, key=lambda one: (abs(float(face.s_of(one.origin)) - s), one.plane)))
    return sides[0], sides[1]


def _is_jamb(one: Face, face: Face, s: float, sign: float) -> bool:
    """Square to the face, looking into the gap from its end at s, and behind the face by no more than a wall."""
    if sign * float(one.normal @ face.along) < np.cos(ALIKE_RAD) or abs(float(face.s_of(one.origin)) - s) > SHORT_M:
        return False
    low, high = one.seen.bounds[1], one.seen.bounds[3]
    before = sorted(float(face.before(end)) for end in _ends(one))
    return low < CUT_M < high and -THICKEST_M <= before[0] <= 0.0 and -SHORT_M <= before[1] <= SHORT_M / 2.0


def _ends(face: Face) -> tuple[FloatArray, FloatArray]:
    return face.point(face.seen.bounds[0]), face.point(face.seen.bounds[2])


def _contains(wall: Wall, gap: Interval) -> bool:
    return wall.span[0] <= gap[0] and gap[1] <= wall.span[1]


def _gap_behind(wall: Wall, gap: Interval) -> Interval | None:
    """What of a gap in the front is one in the back too; None where that is less than half of it."""
    for other in wall.back.gaps_at(CUT_M):
        there = wall.front.beside(wall.back, other)
        low, high = max(gap[0], there[0]), min(gap[1], there[1])
        if high - low > 0.5 * (gap[1] - gap[0]):
            return low, high
    return None


def _box(face: Face, span: Interval, depth: float) -> FloatArray:
    ends = np.array([face.point(span[1]), face.point(span[0])])
    return np.vstack((ends, ends[::-1] - depth * face.normal))
