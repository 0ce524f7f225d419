"""Wall solids, two faces back to back as far as both were seen; openings, gaps between jambs or in both faces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.special import chdtri

from slam.floorplan.faces import ALIKE_RAD, SHORT_M, Face, Interval, shared
from slam.floorplan.quantities import Quantity
from slam.floorplan.rooms import BUILT_RAD, THICKEST_M
from slam.floorplan.storeys import Storey
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Wall:
    """A piece of wall between two faces."""

    front: Face
    """The face it is described along."""
    back: Face
    span: Interval
    """From where to where along the front, m."""
    thickness: Quantity
    """In the middle of the span, m."""

    @property
    def outline(self) -> FloatArray:
        """Its corners in the section, anticlockwise seen from above, shape (4, 3), m."""
        ends = np.array([self.front.point(s) for s in self.span])
        behind = [self.back.point(float(self.back.s_of(end))) for end in ends]
        return np.array([*ends[::-1], *behind])


def wall_solids(storey: Storey, extents: Sequence[tuple[Face, list[Interval]]]) -> list[Wall]:
    """Faces of a storey, and from where to where each goes, paired to walls: a stretch with the nearest behind it."""
    found: list[Wall] = []
    for number, (front, spans) in enumerate(extents):
        left = spans
        for other in _behind(storey, front, [face for face, _ in extents]):
            back, others = extents[other]
            common = shared(left, [front.beside(back, span) for span in others])
            left = without(left, common)
            if other > number:
                found += [Wall(front, back, span, _at(storey, front, back, span)) for span in common]
    return found


def _behind(storey: Storey, front: Face, faces: Sequence[Face]) -> list[int]:
    """Which faces may be the other side of the wall behind one, the nearest first."""
    found = []
    for k, back in enumerate(faces):
        if front.normal @ back.normal <= -np.cos(ALIKE_RAD):
            thickness = _at(storey, front, back, (front.covered[0][0], front.covered[-1][1])).value
            if 0.0 < thickness <= THICKEST_M and _are_parallel(storey, front, back):
                found.append((thickness, k))
    return [k for _, k in sorted(found)]


def _at(storey: Storey, front: Face, back: Face, span: Interval) -> Quantity:
    """How thick a wall is in the middle of a span."""
    direction = (back.normal - front.normal) / np.linalg.norm(back.normal - front.normal)
    place = front.point(0.5 * (span[0] + span[1]))
    return storey.joint.between(front.plane, back.plane, place, direction)


def _are_parallel(storey: Storey, front: Face, back: Face) -> bool:
    """Whether the angle between two faces in the plan is one that noise and building explain, by chi2 of 1 dof."""
    hesse, up = storey.joint.hesse, storey.section.normal
    first, second = hesse[front.plane, :3], hesse[back.plane, :3]
    gradient = np.zeros_like(hesse)
    gradient[front.plane, :3], gradient[back.plane, :3] = np.cross(second, up), np.cross(up, first)
    angle = storey.joint.quantity(float(np.cross(first, second) @ up), gradient)  # off from back to back, rad
    return bool(angle.value**2 / (angle.sigma**2 + BUILT_RAD**2) <= chdtri(1, 1e-3))


def without(spans: list[Interval], taken: list[Interval]) -> list[Interval]:
    """Intervals less others."""
    for low, high in taken:
        pieces = [piece for a, b in spans for piece in ((a, min(b, low)), (max(a, high), b))]
        spans = [(a, b) for a, b in pieces if b > a]
    return spans


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


def find_openings(storey: Storey, faces: Sequence[Face], solids: Sequence[Wall]) -> list[Opening]:
    """The openings of a storey, each once."""
    found: list[Opening] = []
    known: set[frozenset[int]] = set()
    for face in faces:
        for gap in face.gaps_at(CUT_M):
            jambs = _jambs(storey, face, gap)
            if jambs is not None:
                key = frozenset(jamb.plane for jamb in jambs)
                if key not in known:
                    known.add(key)
                    found.append(_between(storey, face, jambs, solids))
                continue
            wall = next((solid for solid in solids if solid.front is face and _contains(solid, gap)), None)
            if wall is not None and (both := _gap_behind(wall, gap)) is not None:
                found.append(_made(storey, face, wall, both, None, wall.thickness.value))
    return found


def _between(storey: Storey, face: Face, jambs: tuple[Face, Face], solids: Sequence[Wall]) -> Opening:
    low, high = (float(face.s_of(jamb.origin)) for jamb in jambs)
    beside = (solid for solid in solids if face in (solid.front, solid.back))
    wall = next((one for one in beside if _contains(one, one.front.beside(face, (low, high)))), None)
    reach = max(-float(face.before(end)) for jamb in jambs for end in jamb.ends)
    depth = wall.thickness.value if wall is not None else reach
    place = face.point(0.5 * (low + high)) - 0.5 * depth * face.normal
    width = storey.joint.between(jambs[0].plane, jambs[1].plane, place, face.along)
    return _made(storey, face, wall, (low, high), width, depth)


def _made(
    storey: Storey, face: Face, wall: Wall | None, span: Interval, width: Quantity | None, depth: float
) -> Opening:
    corners = _box(face, span, depth)
    outline = shapely.Polygon(storey.in_plan(corners))
    middle = corners.mean(axis=0)
    around = outline.buffer(SHORT_M)  # a ceiling or floor that passes over or through the opening goes beyond it
    floor, heights = storey.section.floor, []
    for levels in (storey.ceilings, storey.floors):
        level = storey.over(outline, tuple(level for level in levels if around.covers(level.outline)))
        plane = None if level is None or level.plane == floor else level.plane
        heights.append(storey.rise(floor, plane, middle))
    below, above = face.gap_upright(0.5 * (span[0] + span[1]), CUT_M)
    return Opening(face, wall, span, width, heights[0], heights[1], max(below or 0.0, 0.0), above, depth)


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
    before = sorted(float(face.before(end)) for end in one.ends)
    return low < CUT_M < high and -THICKEST_M <= before[0] <= 0.0 and -SHORT_M <= before[1] <= SHORT_M / 2.0


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
