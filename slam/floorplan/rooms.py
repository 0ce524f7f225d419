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

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from slam.floorplan.faces import ALIKE_RAD, SHORT_M, Face, Interval, closed, covered_length
from slam.floorplan.storeys import Storey

#: Corners of cells are in whole micrometres, so that lines through one point meet in one corner; lines around all, m.
_GRID_M, _AROUND_M = 1e-6, 2.0

#: Faces that look the same way and lie in one line up to this are one line of the plan: a wall that was found twice, or
#: goes on behind another; no wall is so thin, m.
_IN_LINE_M = 0.03

#: A corner of a cell, (x, y) of the plan, m.
Node = tuple[float, float]


@dataclass(frozen=True, eq=False)
class Line:
    """Faces in one line."""

    base: Face
    """The longest, whose line it is."""
    faces: tuple[int, ...]
    """All of them, indices into the walls."""
    covered: list[Interval]
    """Where along the base any of them was seen, ends extended."""

    def span(self, start: Node, end: Node, storey: Storey) -> Interval:
        """From where to where an edge goes along the base."""
        way = (np.array([start, end]) - storey.in_plan(self.base.origin)) @ storey.in_plan(self.base.along)
        return float(way.min()), float(way.max())


@dataclass(frozen=True)
class Edge:
    """A side of a cell, which is on its left, and its line; -1 for the frame round all."""

    start: Node
    end: Node
    cell: int
    line: int


def wall_lines(walls: Sequence[Face]) -> list[Line]:
    """The walls by line, those that were seen longest first."""
    left = sorted(range(len(walls)), key=lambda k: (-sum(high - low for low, high in walls[k].covered), k))
    lines = []
    while left:
        base = walls[left[0]]
        members = [k for k in left if _is_in_line(walls[k], base)]
        left = [k for k in left if k not in members]
        spans = [base.beside(walls[k], span) for k in members for span in walls[k].extended]
        lines.append(Line(base, tuple(members), closed(spans, 0.0)))
    return lines


def _is_in_line(face: Face, base: Face) -> bool:
    ends = np.array([face.point(face.covered[0][0]), face.point(face.covered[-1][1])])
    return bool(face.normal @ base.normal > np.cos(ALIKE_RAD) and np.abs(base.before(ends)).max() < _IN_LINE_M)


def cells_of(storey: Storey, lines: Sequence[Line]) -> list[shapely.Polygon]:
    """The cells that the lines, and a frame round all that was seen, cut the plan into; corners anticlockwise."""
    ends = storey.in_plan(np.array([line.base.point(s) for line in lines for span in line.covered for s in span]))
    (west, south), (east, north) = ends.min(axis=0) - _AROUND_M, ends.max(axis=0) + _AROUND_M
    box = shapely.box(west, south, east, north)
    reach = np.hypot(east - west, north - south)
    middle = np.array([(west + east) / 2.0, (south + north) / 2.0])
    drawn = [box.exterior]
    for line in lines:
        start, along = storey.in_plan(line.base.origin), storey.in_plan(line.base.along)
        foot = start + ((middle - start) @ along) * along
        drawn.append(shapely.intersection(shapely.LineString([foot - reach * along, foot + reach * along]), box))
    noded = shapely.union_all(drawn, grid_size=_GRID_M)
    pieces = shapely.get_parts(shapely.polygonize(shapely.get_parts(noded)))
    return [orient(piece) for piece in pieces]


def edges_of(number: int, cell: shapely.Polygon, storey: Storey, lines: Sequence[Line]) -> list[Edge]:
    """The sides of a cell, each with its line."""
    nodes = shapely.get_coordinates(cell.exterior)
    origins = storey.in_plan(np.array([line.base.origin for line in lines]))
    normals = storey.in_plan(np.array([line.base.normal for line in lines]))
    off = np.abs(np.einsum("nfi,fi->nf", nodes[:, None] - origins[None], normals))
    off = np.maximum(off[:-1], off[1:])
    ends = [(float(x), float(y)) for x, y in nodes]
    edges = []
    for a, b, away in zip(ends[:-1], ends[1:], off, strict=True):
        choice = np.flatnonzero(away < 10.0 * _GRID_M).tolist()
        if len(choice) > 1:  # the two sides of something thin: the one that was seen here
            choice.sort(key=lambda k: -covered_length(lines[k].covered, *lines[k].span(a, b, storey)))
        edges.append(Edge(a, b, number, choice[0] if choice else -1))
    return edges


#: The thickest wall: an insulated outer one, m. What is narrower is no room, planes that are further apart no wall.
THICKEST_M = 0.6
#: How far parallel faces may be from it as they are built, rad: DIN 18202 allows 8 mm in a length of 3 m.
BUILT_RAD = 0.008 / 3.0


def room_rings(storey: Storey, walls: Sequence[Face]) -> list[list[list[int]]]:
    """The rooms of a storey, each as rings of indices into `walls`: one side after the other, room on the left.

    The first ring of a room goes round it, others round what stands in it. Rooms that are not closed are left out.
    """
    if len(walls) < 3:
        return []
    lines = wall_lines(walls)
    cells = cells_of(storey, lines)
    edges = [edge for number, cell in enumerate(cells) for edge in edges_of(number, cell, storey, lines)]
    numbers = {(edge.start, edge.end): number for number, edge in enumerate(edges)}
    joined = _joined(edges, numbers, len(cells), storey, lines)
    found = []
    for room in np.unique(joined):
        inside = shapely.union_all([cells[number] for number in np.flatnonzero(joined == room)])
        border = _rings(inside, edges, numbers)
        if _is_room(border, inside, storey, lines):
            rings = [_sides(ring, storey, lines, walls) for ring in border]
            if all(len(ring) > 2 for ring in rings):
                found.append(rings)
    return found


def _joined(
    edges: Sequence[Edge], numbers: Mapping[tuple[Node, Node], int], n_cells: int, storey: Storey, lines: Sequence[Line]
) -> np.ndarray:
    """The room that each cell belongs to, shape (n_cells,), with the numbers of the edges by their ends."""
    beside = [(edge, numbers.get((edge.end, edge.start))) for edge in edges if not _is_wall(edge, storey, lines)]
    pairs = [(edge.cell, edges[other].cell) for edge, other in beside if other is not None]
    rows, columns = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n_cells, n_cells))
    return connected_components(graph, directed=False)[1]


def _is_wall(edge: Edge, storey: Storey, lines: Sequence[Line]) -> bool:
    if edge.line < 0:
        return False
    low, high = lines[edge.line].span(edge.start, edge.end, storey)
    return covered_length(lines[edge.line].covered, low, high) > 0.5 * (high - low)


def _is_room(rings: Sequence[list[Edge]], inside: BaseGeometry, storey: Storey, lines: Sequence[Line]) -> bool:
    """Closed, wide enough, and seen from inside: no side of any length is the back of a face."""
    border = [edge for ring in rings for edge in ring]
    if any(edge.line < 0 for edge in border) or inside.buffer(-THICKEST_M / 2.0).is_empty:
        return False
    ways = (np.subtract(edge.end, edge.start) @ storey.in_plan(lines[edge.line].base.along) for edge in border)
    return all(way >= -SHORT_M for way in ways)


def _rings(
    inside: shapely.Polygon, edges: Sequence[Edge], numbers: Mapping[tuple[Node, Node], int]
) -> list[list[Edge]]:
    """The border of a room as rings, the longest first, each from that of its edges that comes first."""
    room = orient(inside)
    rings = []
    for corners in (shapely.get_coordinates(ring) for ring in (room.exterior, *room.interiors)):
        ring = [numbers[start, end] for start, end in pairwise(map(tuple, corners.tolist()))]
        first = ring.index(min(ring))
        rings.append(ring[first:] + ring[:first])
    border = [[edges[number] for number in ring] for ring in sorted(rings)]
    return sorted(border, key=lambda ring: -sum(np.hypot(*np.subtract(edge.end, edge.start)) for edge in ring))


def _sides(ring: list[Edge], storey: Storey, lines: Sequence[Line], walls: Sequence[Face]) -> list[int]:
    """The face of each side of a ring: of those in its line the one that was seen most on it."""
    first = next((k for k, edge in enumerate(ring) if edge.line != ring[k - 1].line), 0)
    sides: list[tuple[int, float]] = []
    for number, run in groupby(ring[first:] + ring[:first], key=lambda edge: edge.line):
        line, (start, *_, end) = lines[number], [node for edge in run for node in (edge.start, edge.end)]
        span = line.span(start, end, storey)
        parts = [[line.base.beside(walls[k], one) for one in walls[k].extended] for k in line.faces]
        most_seen = line.faces[int(np.argmax([covered_length(part, *span) for part in parts]))]
        sides.append((most_seen, span[1] - span[0]))
    return _with_corners(sides, walls)


def _with_corners(sides: list[tuple[int, float]], walls: Sequence[Face]) -> list[int]:
    """Faces of sides (face, length); of two neighbours that are parallel as built, the shorter is left out."""
    while len(sides) > 2:
        normals = np.array([walls[face].normal for face, _ in sides])
        turns = np.linalg.norm(np.cross(normals, np.roll(normals, 1, axis=0)), axis=1)
        flat = int(np.argmin(turns))
        if turns[flat] > BUILT_RAD:
            break
        sides.pop(min(flat, flat - 1, key=lambda k: sides[k][1]))
    return [face for face, _ in sides]
