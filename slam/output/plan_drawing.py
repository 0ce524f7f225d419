"""A floor plan as a drawing: polygons, lines, dimensions and texts in plan coordinates; as SVG."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import chain
from pathlib import Path

import numpy as np
import shapely

from slam.floorplan.plan import FloorPlan, StoreyPlan
from slam.floorplan.walls import Opening
from slam.geometry.polygons import polygons_of
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class Dimension:
    """A length between two points with its text."""

    kind: str
    """width, side, thickness or opening."""
    start: FloatArray
    """Shape (2,), m."""
    end: FloatArray
    """Shape (2,), m."""
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


@dataclass(eq=False)
class Drawing:
    """The drawing of one storey, in its plan's coordinates."""

    name: str
    elevation: float
    """Of its floor above the lowest one, m."""
    title: str
    walls: list[tuple[FloatArray, ...]] = field(default_factory=list)
    """Rings of corners (N, 2) of each solid, less the openings in it."""
    faces: list[FloatArray] = field(default_factory=list)
    """Faces of walls whose other side was not seen, ends (2, 2)."""
    openings: list[FloatArray] = field(default_factory=list)
    """Corners of each, shape (4, 2); the first two are on the face that it is described along."""
    rooms: list[tuple[FloatArray, ...]] = field(default_factory=list)
    """Rings of corners (N, 2) of each."""
    dimensions: list[Dimension] = field(default_factory=list)
    labels: list[Label] = field(default_factory=list)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """(x low, y low, x high, y high) of all lines, m."""
        points = np.vstack([*self.faces, *self.openings, *chain.from_iterable(self.walls + self.rooms)])
        return (*points.min(axis=0).tolist(), *points.max(axis=0).tolist())


#: Where lengths of sides and heights of openings are written, off the wall, m.
_INSIDE_M = 0.2


def drawings(plan: FloorPlan, verdict: str | None = None) -> list[Drawing]:
    """The drawing of every storey, from below; titles have the run's verdict on its map unless that is sound."""
    return [_drawing(number, storey, verdict) for number, storey in enumerate(plan.storeys)]


def _drawing(number: int, plan: StoreyPlan, verdict: str | None) -> Drawing:
    in_plan = plan.storey.in_plan
    elevation = 0.0 if plan.elevation is None else plan.elevation.value
    drawing = Drawing(f"storey {number}", elevation, _title(number, plan, verdict))
    outlines = [in_plan(one.outline) for one in plan.openings]
    holes = shapely.union_all([shapely.Polygon(_stretched(one)) for one in outlines])
    for wall in plan.walls:
        for solid in polygons_of(shapely.Polygon(in_plan(wall.outline)).difference(holes)):
            rings = (solid.exterior, *solid.interiors)
            drawing.walls.append(tuple(shapely.get_coordinates(ring)[:-1] for ring in rings))
        middle = in_plan(wall.front.point(0.75 * wall.span[0] + 0.25 * wall.span[1]))
        back = middle - wall.thickness.value * in_plan(wall.front.normal)
        drawing.dimensions.append(Dimension("thickness", middle, back, str(wall.thickness)))
    drawing.faces = [in_plan(np.array([face.point(s) for s in span])) for face, span in plan.single]
    drawing.openings = outlines
    drawing.dimensions += [_of_opening(one, outline) for one, outline in zip(plan.openings, outlines, strict=True)]
    for place, room in enumerate(plan.rooms):
        drawing.rooms.append(tuple(in_plan(ring) for ring in room.outline))
        drawing.dimensions += [
            Dimension("width", in_plan(w.first), in_plan(w.second), str(w.distance)) for w in room.widths
        ]
        for side in room.sides:
            ends = in_plan(side.start), in_plan(side.end)
            drawing.dimensions.append(Dimension("side", *ends, str(side.length), _INSIDE_M))
        height = () if room.height is None else (f"height {room.height} m",)
        drawing.labels.append(Label(in_plan(room.middle), (room_name(place), f"{room.area} m2", *height)))
    for opening in plan.openings:
        said = [f"{name} {value}" for name, value in (("lintel", opening.height), ("sill", opening.sill)) if value]
        if said:
            beside = in_plan(opening.outline[:2].mean(axis=0) + _INSIDE_M * opening.face.normal)
            drawing.labels.append(Label(beside, tuple(said)))
    return drawing


def room_name(number: int) -> str:
    """The name of a room of a storey."""
    return f"room {number + 1}"


def _title(number: int, plan: StoreyPlan, verdict: str | None) -> str:
    height = plan.elevation
    floor = "no floor was seen" if height is None else f"floor at {height if height.sigma > 0.0 else 0} m"
    closed = "" if plan.rooms else "no room was seen all round; "
    warning = "" if verdict in (None, "sound") else f"; the run calls its map {verdict}"
    return f"storey {number}: {floor}; {closed}standard deviations from the joint covariance of all planes{warning}"


def _stretched(outline: FloatArray) -> FloatArray:
    """An opening a little deeper than its wall, so that nothing of the wall stays in it."""
    middle, depth = outline.mean(axis=0), 0.05 * (outline[0] - outline[3])
    return outline + np.sign((outline - middle) @ depth)[:, None] * depth


def _of_opening(opening: Opening, outline: FloatArray) -> Dimension:
    text = f"about {opening.span[1] - opening.span[0]:.1f}" if opening.width is None else str(opening.width)
    ends = 0.5 * (outline[[1, 0]] + outline[[2, 3]])
    return Dimension("opening", ends[0], ends[1], text)


#: Millimetres of the picture to a metre: a scale of 1:50.
_MM = 20.0
#: Margin round a storey and height of a title, mm.
_MARGIN, _TITLE = 12.0, 8.0
#: Sizes of texts, mm.
_SIZES = {"side": 1.8, "width": 2.2, "thickness": 1.5, "opening": 1.7, "label": 2.0}
_COLOURS = {"side": "#777", "width": "#05a", "thickness": "#a40", "opening": "#080"}
_STYLE = (
    "text{font-family:sans-serif}.room{fill:#eef4fb;stroke:none}.wall{fill:#444;stroke:none}"
    ".face{stroke:#444;stroke-width:.6;stroke-dasharray:2 1}.side{stroke:#444;stroke-width:.4;fill:none}"
    ".opening{fill:#fff;stroke:#080;stroke-width:.2}"
)


def write_svg(path: Path, plan: FloorPlan, verdict: str | None = None) -> None:
    """Write the drawing of every storey; dashed lines are faces of walls whose other side was not seen."""
    storeys = drawings(plan, verdict)
    sizes = [(b[2] - b[0], b[3] - b[1]) for b in (one.bounds for one in storeys)]
    width = max(w for w, _ in sizes) * _MM + 2.0 * _MARGIN
    height = sum(h * _MM + 2.0 * _MARGIN + _TITLE for _, h in sizes)
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.1f}mm" height="{height:.1f}mm" '
        f'viewBox="0 0 {width:.2f} {height:.2f}">',
        f'<style>{_STYLE}</style><rect width="100%" height="100%" fill="#fff"/>',
    ]
    top = 0.0
    for storey, (_, deep) in zip(storeys, sizes, strict=True):
        west, _, _, north = storey.bounds
        parts.append(f'<g id="{storey.name.replace(" ", "-")}" data-elevation="{storey.elevation:.4f}">')
        parts.append(f'<text x="{_MARGIN:.2f}" y="{top + _TITLE:.2f}" font-size="3">{escape(storey.title)}</text>')
        corner = np.array([_MARGIN - west * _MM, top + _TITLE + _MARGIN + north * _MM])
        parts += _storey(storey, corner)
        parts.append("</g>")
        top += deep * _MM + 2.0 * _MARGIN + _TITLE
    path.write_text("\n".join([*parts, "</svg>\n"]), encoding="utf-8")


def _storey(storey: Drawing, corner: FloatArray) -> Iterator[str]:
    def on_page(xy: FloatArray) -> FloatArray:
        return corner + xy * np.array([_MM, -_MM])

    def path(rings: Sequence[FloatArray]) -> str:
        return "".join("M" + "L".join(f"{x:.3f} {y:.3f}" for x, y in on_page(ring)) + "Z" for ring in rings)

    for rings in storey.rooms:
        yield f'<path class="room" fill-rule="evenodd" d="{path(rings)}"/>'
        yield f'<path class="side" d="{path(rings)}"/>'
    for rings in storey.walls:
        yield f'<path class="wall" fill-rule="evenodd" d="{path(rings)}"/>'
    for ends in storey.faces:
        yield f'<line class="face" {_ends(*on_page(ends))}/>'
    for outline in storey.openings:
        yield f'<path class="opening" d="{path([outline])}"/>'
    for dimension in storey.dimensions:
        yield _dimension(dimension, on_page(dimension.start), on_page(dimension.end))
    for label in storey.labels:
        yield from _label(label, on_page(label.place))


def _ends(start: FloatArray, end: FloatArray) -> str:
    return f'x1="{start[0]:.3f}" y1="{start[1]:.3f}" x2="{end[0]:.3f}" y2="{end[1]:.3f}"'


def _label(label: Label, place: FloatArray) -> Iterator[str]:
    """Lines above a place; those of a room stand to the right of where its widths cross."""
    size = _SIZES["label"] if len(label.lines) > 1 else _SIZES["opening"]
    anchor, x = ("start", place[0] + 0.5 * size) if len(label.lines) > 1 else ("middle", place[0])
    for row, line in enumerate(label.lines):
        y = place[1] + (row - len(label.lines) - 0.2) * 1.25 * size
        yield f'<text x="{x:.2f}" y="{y:.2f}" font-size="{size}" style="text-anchor:{anchor}">{escape(line)}</text>'


def _dimension(one: Dimension, start: FloatArray, end: FloatArray) -> str:
    """The text along its line, upright or read from the right; widths with their line, from wall to wall."""
    way = end - start
    length = float(np.hypot(*way))
    along = way / max(length, 1e-9)
    left = np.array([along[1], -along[0]])  # y of the page points down
    size, colour = _SIZES[one.kind], _COLOURS[one.kind]
    shift = one.offset * _MM * left
    place = start + 0.5 * way + shift
    if one.kind == "width":  # at the left or the lower end, for the room's own text stands right of the middle
        half = 0.3 * size * len(one.text) + size
        low, lower = (start, along) if along[0] - along[1] > 0.0 else (end, -along)
        place = low + max(0.22 * length, min(half, 0.5 * length)) * lower
    line = ""
    if one.kind in ("width", "thickness"):
        line = f'<line {_ends(start + shift, end + shift)} stroke="{colour}" stroke-width=".15"/>'
    angle = float(np.degrees(np.arctan2(along[1], along[0])))
    angle += 180.0 if angle < -90.1 else -180.0 if angle > 89.9 else 0.0  # read from below or from the right
    drop, anchor = 0.25 * size if one.kind in ("side", "opening") else -0.4 * size, "middle"
    if one.kind == "thickness":
        place, angle, drop = end + size * along, 0.0, 0.35 * size
        anchor = "middle" if abs(along[0]) < 0.7 else "start" if along[0] > 0.0 else "end"
    x, y = place
    return (
        f'{line}<text data-kind="{one.kind}" transform="translate({x:.2f} {y:.2f}) rotate({angle:.2f})" y="{drop:.2f}" '
        f'font-size="{size}" fill="{colour}" style="text-anchor:{anchor}">{escape(one.text)}</text>'
    )
