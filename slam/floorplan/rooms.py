"""Rooms: cells of the arrangement of wall lines, joined where no wall was seen between them.

Every wall is a line through the whole storey, and the lines cut the plan into cells. Two cells are one where less than
half of the edge between them was seen of the wall on it. What is left enclosed, with the seen side of every face
inward, is a room; its corners are intersections of faces.

References:
    Mura, Mattausch, Jaspe Villanueva, Gobbetti, Pajarola, "Automatic room detection and reconstruction in cluttered
    indoor environments with complex room layouts", Computers & Graphics 2014, for the arrangement of wall lines.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import groupby

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry.base import BaseGeometry

from slam.floorplan.arrangement import Edge, Line, Node, cells_of, edges_of, wall_lines
from slam.floorplan.faces import SHORT_M, Face, Interval, covered_length
from slam.floorplan.storeys import Storey

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
    joined = _joined(edges, len(cells), storey, lines)
    found = []
    for room, border in sorted(_borders(edges, joined).items()):
        inside = shapely.union_all([cells[number] for number in np.flatnonzero(joined == room)])
        if _is_room(border, inside, storey, lines):
            rings = [_sides(ring, storey, lines, walls) for ring in _rings(border)]
            if all(len(ring) > 2 for ring in rings):
                found.append(rings)
    return found


def _joined(edges: Sequence[Edge], n_cells: int, storey: Storey, lines: Sequence[Line]) -> np.ndarray:
    """The room that each cell belongs to, shape (n_cells,)."""
    beside = {(edge.start, edge.end): edge.cell for edge in edges}
    pairs = [
        (edge.cell, beside[edge.end, edge.start])
        for edge in edges
        if (edge.end, edge.start) in beside and not _is_wall(edge, storey, lines)
    ]
    rows, columns = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n_cells, n_cells))
    return connected_components(graph, directed=False)[1]


def _is_wall(edge: Edge, storey: Storey, lines: Sequence[Line]) -> bool:
    if edge.line < 0:
        return False
    low, high = lines[edge.line].span(edge.start, edge.end, storey)
    return covered_length(lines[edge.line].covered, low, high) > 0.5 * (high - low)


def _borders(edges: Sequence[Edge], joined: np.ndarray) -> dict[int, list[Edge]]:
    """Of each room the edges of its cells that are not inside it."""
    rooms = {(edge.start, edge.end): int(joined[edge.cell]) for edge in edges}
    borders = defaultdict(list)
    for edge in edges:
        room = int(joined[edge.cell])
        if rooms.get((edge.end, edge.start), -1) != room:
            borders[room].append(edge)
    return borders


def _is_room(border: Sequence[Edge], inside: BaseGeometry, storey: Storey, lines: Sequence[Line]) -> bool:
    """Closed, wide enough, and seen from inside: no side of any length is the back of a face."""
    if any(edge.line < 0 for edge in border) or inside.buffer(-THICKEST_M / 2.0).is_empty:
        return False
    for edge in border:
        way = np.array(edge.end) - np.array(edge.start)
        if way @ storey.in_plan(lines[edge.line].base.along) < -SHORT_M:
            return False
    return True


def _rings(border: Sequence[Edge]) -> list[list[Edge]]:
    """The border as rings, the longest first."""
    leaving = defaultdict(list)
    for edge in border:
        leaving[edge.start].append(edge)
    rings = []
    while leaving:
        start = next(iter(leaving))
        ring, edge = [], _take(leaving, start, None)
        while edge is not None:
            ring.append(edge)
            edge = None if edge.end == ring[0].start else _take(leaving, edge.end, edge)
        rings.append(ring)
    return sorted(rings, key=lambda ring: -sum(np.hypot(*np.subtract(edge.end, edge.start)) for edge in ring))


def _take(leaving: dict[Node, list[Edge]], node: Node, coming: Edge | None) -> Edge | None:
    """The edge to go on with; where the border touches itself, the one most to the right keeps rings apart."""
    choice = leaving.get(node)
    if not choice:
        return None
    best = 0 if coming is None else int(np.argmin([_turn(coming, edge) for edge in choice]))
    edge = choice.pop(best)
    if not choice:
        del leaving[node]
    return edge


def _turn(coming: Edge, going: Edge) -> float:
    """Turn to the left from one edge to the next, rad."""
    (ax, ay), (bx, by) = np.subtract(coming.end, coming.start), np.subtract(going.end, going.start)
    return float(np.arctan2(ax * by - ay * bx, ax * bx + ay * by))


def _sides(ring: list[Edge], storey: Storey, lines: Sequence[Line], walls: Sequence[Face]) -> list[int]:
    """The face of each side of a ring: of those in its line the one that was seen most on it."""
    first = next((k for k, edge in enumerate(ring) if edge.line != ring[k - 1].line), 0)
    sides: list[tuple[int, float]] = []
    for number, run in groupby(ring[first:] + ring[:first], key=lambda edge: edge.line):
        line, (start, *_, end) = lines[number], [node for edge in run for node in (edge.start, edge.end)]
        span = line.span(start, end, storey)
        sides.append((_most_seen(line, span, walls), span[1] - span[0]))
    return _with_corners(sides, walls)


def _most_seen(line: Line, span: Interval, walls: Sequence[Face]) -> int:
    parts = [[line.base.beside(walls[k], one) for one in walls[k].extended] for k in line.faces]
    return line.faces[int(np.argmax([covered_length(one, *span) for one in parts]))]


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
