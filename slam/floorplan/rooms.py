"""Rooms: cells of the arrangement of wall lines, joined where no wall was seen between them.

Every wall is a line through the whole storey, and the lines cut the plan into cells. Two cells are one where less than
half of the edge between them was seen of the wall on it. What is left enclosed, with the seen side of every face
inward, is a room; its corners are intersections of faces.

References:
    Mura, Mattausch, Jaspe Villanueva, Gobbetti, Pajarola, "Automatic room detection and reconstruction in cluttered
    indoor environments with complex room layouts", Computers & Graphics 2014, for the arrangement of wall lines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise
from typing import NamedTuple

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from slam.floorplan.faces import ALIKE_RAD, SHORT_M, Face, Interval, closed, covered_length
from slam.floorplan.storeys import Storey
from spplanes._check import FloatArray

#: Corners of cells are in whole micrometres, so that lines through one point meet in one corner, m.
_GRID_M = 1e-6
#: A corner of a cell, (x, y) of the plan, m.
Node = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Line:
    """Faces in one line."""

    base: Face
    """The longest, whose line it is."""
    start: FloatArray
    """The point of it at s = 0 in the plan, shape (2,), m."""
    along: FloatArray
    """Its direction in the plan, shape (2,)."""
    faces: list[Face]
    """All of them."""
    covered: list[Interval]
    """Where along the base any of them was seen, ends extended."""

    def span(self, start: Node, end: Node) -> Interval:
        """From where to where an edge goes along the base."""
        way = (np.array([start, end]) - self.start) @ self.along
        return float(way.min()), float(way.max())


class Edge(NamedTuple):
    """A side of a cell, which is on its left, and its line; None: the frame round all."""

    number: int
    start: Node
    end: Node
    cell: int
    line: Line | None


#: The sides of all cells by their ends.
Edges = Mapping[tuple[Node, Node], Edge]


def wall_lines(walls: Sequence[Face], storey: Storey) -> list[Line]:
    """The walls by line, those that were seen longest first."""
    left = sorted(walls, key=lambda face: -sum(high - low for low, high in face.covered))
    lines = []
    while left:
        base = left[0]
        members = [face for face in left if _is_in_line(face, base)]
        left = [face for face in left if face not in members]
        spans = [base.beside(face, span) for face in members for span in face.extended]
        start, along = storey.in_plan(base.origin), storey.in_plan(base.along)
        lines.append(Line(base, start, along, members, closed(spans, 0.0)))
    return lines


def _is_in_line(face: Face, base: Face) -> bool:
    """Whether faces that look the same way are one wall, found twice or going on behind another: none is 3 cm thin."""
    ends = np.array([face.point(face.covered[0][0]), face.point(face.covered[-1][1])])
    return bool(face.normal @ base.normal > np.cos(ALIKE_RAD) and np.abs(base.before(ends)).max() < 0.03)


def cells_of(storey: Storey, lines: Sequence[Line]) -> list[shapely.Polygon]:
    """The cells that the lines, and a frame 2 m round all that was seen, cut the plan into; corners anticlockwise."""
    ends = storey.in_plan(np.array([line.base.point(s) for line in lines for span in line.covered for s in span]))
    (west, south), (east, north) = ends.min(axis=0) - 2.0, ends.max(axis=0) + 2.0
    box = shapely.box(west, south, east, north)
    reach = np.hypot(east - west, north - south)
    middle = np.array([(west + east) / 2.0, (south + north) / 2.0])
    drawn = [box.exterior]
    for line in lines:
        foot, way = line.start + ((middle - line.start) @ line.along) * line.along, reach * line.along
        drawn.append(shapely.intersection(shapely.LineString([foot - way, foot + way]), box))
    noded = shapely.union_all(drawn, grid_size=_GRID_M)
    pieces = shapely.get_parts(shapely.polygonize(shapely.get_parts(noded)))
    return [orient(piece) for piece in pieces]


def edges_of(cells: Sequence[shapely.Polygon], storey: Storey, lines: Sequence[Line]) -> dict[tuple[Node, Node], Edge]:
    """The sides of cells, each with its line, by their ends."""
    starts = np.array([line.start for line in lines])
    normals = storey.in_plan(np.array([line.base.normal for line in lines]))
    edges: dict[tuple[Node, Node], Edge] = {}
    for number, cell in enumerate(cells):
        nodes = shapely.get_coordinates(cell.exterior)
        off = np.abs(np.einsum("nfi,fi->nf", nodes[:, None] - starts[None], normals))
        for (a, b), away in zip(pairwise(map(tuple, nodes.tolist())), np.maximum(off[:-1], off[1:]), strict=True):
            near = [lines[k] for k in np.flatnonzero(away < 10.0 * _GRID_M).tolist()]
            # of the two sides of something thin the one that was seen here
            line = max(near, key=lambda one: covered_length(one.covered, *one.span(a, b)), default=None)
            edges[a, b] = Edge(len(edges), a, b, number, line)
    return edges


#: The thickest wall: an insulated outer one, m. What is narrower is no room, planes that are further apart no wall.
THICKEST_M = 0.6
#: How far parallel faces may be from it as they are built, rad: DIN 18202 allows 8 mm in a length of 3 m.
BUILT_RAD = 0.008 / 3.0


def room_rings(storey: Storey, walls: Sequence[Face]) -> list[list[list[Face]]]:
    """The rooms of a storey, each as rings of walls: one side after the other, room on the left.

    The first ring of a room goes round it, others round what stands in it. Rooms that are not closed are left out.
    """
    if len(walls) < 3:
        return []
    lines = wall_lines(walls, storey)
    cells = cells_of(storey, lines)
    edges = edges_of(cells, storey, lines)
    joined = _joined(edges, len(cells))
    found = []
    for room in np.unique(joined):
        inside = shapely.union_all([cells[number] for number in np.flatnonzero(joined == room)])
        border = _rings(inside, edges)
        if _is_room(border, inside):
            rings = [_sides(ring) for ring in border]
            if all(len(ring) > 2 for ring in rings):
                found.append(rings)
    return found


def _joined(edges: Edges, n_cells: int) -> np.ndarray:
    """The room that each cell belongs to, shape (n_cells,)."""
    beside = [(edge, edges.get((edge.end, edge.start))) for edge in edges.values() if not _is_wall(edge)]
    pairs = [(edge.cell, other.cell) for edge, other in beside if other is not None]
    rows, columns = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n_cells, n_cells))
    return connected_components(graph, directed=False)[1]


def _is_wall(edge: Edge) -> bool:
    if edge.line is None:
        return False
    low, high = edge.line.span(edge.start, edge.end)
    return covered_length(edge.line.covered, low, high) > 0.5 * (high - low)


def _is_room(rings: Sequence[list[Edge]], inside: BaseGeometry) -> bool:
    """Closed, wide enough, and seen from inside: no side of any length is the back of a face."""
    inward = (
        edge.line is not None and np.subtract(edge.end, edge.start) @ edge.line.along >= -SHORT_M
        for ring in rings
        for edge in ring
    )
    return all(inward) and not inside.buffer(-THICKEST_M / 2.0).is_empty


def _rings(inside: shapely.Polygon, edges: Edges) -> list[list[Edge]]:
    """The border of a room as rings, the longest first, each from that of its edges that comes first."""
    room = orient(inside)
    rings = []
    for corners in (shapely.get_coordinates(ring) for ring in (room.exterior, *room.interiors)):
        ring = [edges[ends] for ends in pairwise(map(tuple, corners.tolist()))]
        first = ring.index(min(ring))
        rings.append(ring[first:] + ring[:first])
    return sorted(sorted(rings), key=lambda ring: -sum(np.hypot(*np.subtract(edge.end, edge.start)) for edge in ring))


def _sides(ring: list[Edge]) -> list[Face]:
    """The face of each side of a ring: of those in its line the one that was seen most on it."""
    first = next((k for k, edge in enumerate(ring) if edge.line is not ring[k - 1].line), 0)
    sides: list[tuple[Face, float]] = []
    for line, run in groupby(ring[first:] + ring[:first], key=lambda edge: edge.line):
        assert line is not None  # `_is_room`
        start, *_, end = [node for edge in run for node in (edge.start, edge.end)]
        span = line.span(start, end)
        parts = [[line.base.beside(face, one) for one in face.extended] for face in line.faces]
        most_seen = line.faces[int(np.argmax([covered_length(part, *span) for part in parts]))]
        sides.append((most_seen, span[1] - span[0]))
    return _with_corners(sides)


def _with_corners(sides: list[tuple[Face, float]]) -> list[Face]:
    """Faces of sides (face, length); of two neighbours that are parallel as built, the shorter is left out."""
    while len(sides) > 2:
        normals = np.array([face.normal for face, _ in sides])
        turns = np.linalg.norm(np.cross(normals, np.roll(normals, 1, axis=0)), axis=1)
        flat = int(np.argmin(turns))
        if turns[flat] > BUILT_RAD:
            break
        sides.pop(min(flat, flat - 1, key=lambda k: sides[k][1]))
    return [face for face, _ in sides]
