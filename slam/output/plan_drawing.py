"""A floor plan as a drawing: polygons, lines, dimensions and texts in plan coordinates, for whatever writes them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import shapely

from slam.floorplan.openings import Opening
from slam.floorplan.plan import FloorPlan, Room, StoreyPlan
from slam.floorplan.quantities import Quantity
from slam.geometry.polygons import polygons_of
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Dimension:
    """A length between two points with its text."""

    kind: str
    """width, side, thickness or opening."""
    start: FloatArray
    """One end, shape (2,), m."""
    end: FloatArray
    """The other, shape (2,), m."""
    text: str
    """Value and standard deviation, m."""
    offset: float = 0.0
    """How far to the left of the way from start to end the dimension line is drawn, m."""


@dataclass(frozen=True, eq=False)
class Label:
    """Lines of text."""

    place: FloatArray
    """Their middle, shape (2,), m."""
    lines: tuple[str, ...]
    """From above."""


@dataclass(eq=False)
class Drawing:
    """The drawing of one storey, in its plan's coordinates."""

    name: str
    """storey 0 is the lowest."""
    elevation: float
    """Of its floor above the lowest one, m."""
    title: str
    """What is to be said of all of it."""
    walls: list[shapely.Polygon] = field(default_factory=list)
    """Solids, less the openings in them."""
    faces: list[FloatArray] = field(default_factory=list)
    """Faces of walls whose other side was not seen, ends (2, 2)."""
    openings: list[FloatArray] = field(default_factory=list)
    """Corners of each, shape (4, 2); the first two are on the face that it is described along."""
    rooms: list[tuple[FloatArray, ...]] = field(default_factory=list)
    """Rings of corners (N, 2) of each."""
    dimensions: list[Dimension] = field(default_factory=list)
    """Lengths."""
    labels: list[Label] = field(default_factory=list)
    """Areas and heights."""

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(x low, y low, x high, y high) of all lines, m."""
        lines = [shapely.get_coordinates(one) for one in self.walls] + self.faces
        points = np.vstack([*lines, *self.openings, *(ring for rings in self.rooms for ring in rings)])
        return (*points.min(axis=0).tolist(), *points.max(axis=0).tolist())


#: Where lengths of sides and heights of openings are written, off the wall, m.
_INSIDE_M = 0.2


def drawings(plan: FloorPlan, verdict: str | None = None) -> list[Drawing]:
    """The drawing of every storey, from below.

    Args:
        plan: what was measured.
        verdict: what the run says of its map; said in the title unless the map is sound.
    """
    return [_drawing(number, one, verdict) for number, one in enumerate(plan.storeys)]


def _drawing(number: int, plan: StoreyPlan, verdict: str | None) -> Drawing:
    in_plan = plan.storey.in_plan
    elevation = 0.0 if plan.elevation is None else plan.elevation.value
    drawing = Drawing(f"storey {number}", elevation, _title(number, plan, verdict))
    outlines = [in_plan(one.outline) for one in plan.openings]
    holes = shapely.union_all([shapely.Polygon(_stretched(one)) for one in outlines])
    for wall in plan.walls:
        drawing.walls += polygons_of(shapely.Polygon(in_plan(wall.outline)).difference(holes))
        middle = in_plan(wall.front.point(0.75 * wall.span[0] + 0.25 * wall.span[1]))
        back = middle - wall.thickness.value * in_plan(wall.front.normal)
        drawing.dimensions.append(Dimension("thickness", middle, back, str(wall.thickness)))
    drawing.faces = [in_plan(np.array([face.point(s) for s in span])) for face, span in plan.single]
    drawing.openings = outlines
    drawing.dimensions += [_of_opening(one, outline) for one, outline in zip(plan.openings, outlines, strict=True)]
    for place, room in enumerate(plan.rooms):
        drawing.rooms.append(tuple(in_plan(ring) for ring in room.outline))
        drawing.dimensions += _of_room(room, plan)
        drawing.labels.append(Label(in_plan(room.middle), room_lines(place, room)))
    for opening in plan.openings:
        said = [f"{name} {value}" for name, value in (("lintel", opening.height), ("sill", opening.sill)) if value]
        if said:
            beside = in_plan(opening.outline[:2].mean(axis=0) + _INSIDE_M * opening.face.normal)
            drawing.labels.append(Label(beside, tuple(said)))
    return drawing


def room_name(number: int) -> str:
    """The name of a room of a storey."""
    return f"room {number + 1}"


def room_lines(number: int, room: Room) -> tuple[str, ...]:
    """What is written into a room."""
    height = () if room.height is None else (f"height {room.height} m",)
    return room_name(number), f"{room.area} m2", *height


def _title(number: int, plan: StoreyPlan, verdict: str | None) -> str:
    floor = "no floor was seen" if plan.elevation is None else f"floor at {_elevation(plan.elevation)} m"
    closed = "" if plan.rooms else "no room was seen all round; "
    warning = "" if verdict in (None, "sound") else f"; the run calls its map {verdict}"
    return f"storey {number}: {floor}; {closed}standard deviations from the joint covariance of all planes{warning}"


def _elevation(height: Quantity) -> str:
    return str(height) if height.sigma > 0.0 else "0"


def _stretched(outline: FloatArray) -> FloatArray:
    """An opening a little deeper than its wall, so that nothing of the wall stays in it."""
    middle, depth = outline.mean(axis=0), 0.05 * (outline[0] - outline[3])
    return outline + np.sign((outline - middle) @ depth)[:, None] * depth


def _of_opening(opening: Opening, outline: FloatArray) -> Dimension:
    text = f"about {opening.span[1] - opening.span[0]:.1f}" if opening.width is None else str(opening.width)
    ends = 0.5 * (outline[[1, 0]] + outline[[2, 3]])
    return Dimension("opening", ends[0], ends[1], text)


def _of_room(room: Room, plan: StoreyPlan) -> list[Dimension]:
    in_plan = plan.storey.in_plan
    found = [Dimension("width", in_plan(w.first), in_plan(w.second), str(w.distance)) for w in room.widths]
    for ring in room.rings:
        found += [Dimension("side", in_plan(s.start), in_plan(s.end), str(s.length), _INSIDE_M) for s in ring]
    return found
