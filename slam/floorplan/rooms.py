"""Rooms: cells of the arrangement of wall lines, joined where no wall was seen between them.

Every wall face is a line through the whole storey, and the lines cut the plan into cells. Two cells are one where less
than half of the edge between them was covered by its face. What is left enclosed, with the seen side of every face
inward, is a room; its corners are intersections of faces.

References:
    Mura, Mattausch, Jaspe Villanueva, Gobbetti, Pajarola, "Automatic room detection and reconstruction in cluttered
    indoor environments with complex room layouts", Computers & Graphics 2014, for the arrangement of wall lines.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from shapely.geometry.base import BaseGeometry
from shapely.geometry.polygon import orient

from slam.floorplan.faces import SHORT_M, Face, covered_length
from slam.floorplan.storeys import Storey

#: The thickest wall: an insulated outer one, m. What is narrower is no room, planes that are further apart no wall.
THICKEST_M = 0.6
#: Corners of cells are in whole micrometres, so that lines through one point meet in one corner; lines around all, m.
_GRID_M, _AROUND_M = 1e-6, 2.0

Node = tuple[float, float]


@dataclass(frozen=True)
class _Edge:
    """A side of a cell: from, to, the cell on its left and its face, -1 for the frame round all."""

    start: Node
    end: Node
    cell: int
    face: int


def room_rings(storey: Storey, walls: Sequence[Face]) -> list[list[list[int]]]:
    """The rooms of a storey, each as rings of indices into `walls`: one side after the other, room on the left.

    The first ring of a room goes round it, others round what stands in it. Rooms that are not closed are left out.
    """
    if len(walls) < 3:
        return []
    cells = _cells(storey, walls)
    edges = [edge for number, cell in enumerate(cells) for edge in _edges_of(number, cell, storey, walls)]
    joined = _joined(edges, len(cells), storey, walls)
    found = []
    for room in range(int(joined.max(initial=-1)) + 1):
        border = _border([edge for edge in edges if joined[edge.cell] == room], edges, joined)
        inside = shapely.union_all([cells[number] for number in np.flatnonzero(joined == room)])
        if _is_room(border, inside, storey, walls):
            found.append(_rings(border))
    return found


def _cells(storey: Storey, walls: Sequence[Face]) -> list[shapely.Polygon]:
    ends = storey.in_plan(np.array([face.point(s) for face in walls for s in face.extended[0] + face.extended[-1]]))
    (west, south), (east, north) = ends.min(axis=0) - _AROUND_M, ends.max(axis=0) + _AROUND_M
    box = shapely.box(west, south, east, north)
    reach = np.hypot(east - west, north - south)
    middle = np.array([(west + east) / 2.0, (south + north) / 2.0])
    lines = [box.exterior]
    for face in walls:
        start, along = storey.in_plan(face.origin), storey.in_plan(face.along)
        foot = start + ((middle - start) @ along) * along
        lines.append(shapely.intersection(shapely.LineString([foot - reach * along, foot + reach * along]), box))
    noded = shapely.union_all(lines, grid_size=_GRID_M)
    pieces = shapely.get_parts(shapely.polygonize(shapely.get_parts(noded)))
    return [orient(piece) for piece in pieces]


def _edges_of(number: int, cell: shapely.Polygon, storey: Storey, walls: Sequence[Face]) -> list[_Edge]:
    nodes = shapely.get_coordinates(cell.exterior)
    origins = storey.in_plan(np.array([face.origin for face in walls]))
    normals = storey.in_plan(np.array([face.normal for face in walls]))
    off = np.abs(np.einsum("nfi,fi->nf", nodes[:, None] - origins[None], normals))
    near = np.maximum(off[:-1], off[1:]) < 10.0 * _GRID_M
    ends = [(float(x), float(y)) for x, y in nodes]
    edges = []
    for a, b, faces in zip(ends[:-1], ends[1:], near, strict=True):
        choice = np.flatnonzero(faces).tolist()
        if len(choice) > 1:  # faces in one line: the one that was seen here
            choice.sort(key=lambda k: -_coverage((a, b), walls[k], storey))
        edges.append(_Edge(a, b, number, choice[0] if choice else -1))
    return edges


def _joined(edges: Sequence[_Edge], n_cells: int, storey: Storey, walls: Sequence[Face]) -> np.ndarray:
    """The room that each cell belongs to, shape (n_cells,)."""
    beside = {(edge.start, edge.end): edge.cell for edge in edges}
    pairs = [
        (edge.cell, beside[edge.end, edge.start])
        for edge in edges
        if (edge.end, edge.start) in beside and not _is_wall(edge, storey, walls)
    ]
    rows, columns = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), shape=(n_cells, n_cells))
    return connected_components(graph, directed=False)[1]


def _is_wall(edge: _Edge, storey: Storey, walls: Sequence[Face]) -> bool:
    return edge.face >= 0 and _coverage((edge.start, edge.end), walls[edge.face], storey) > 0.5


def _coverage(ends: tuple[Node, Node], face: Face, storey: Storey) -> float:
    """Share of an edge on the line of a face that was seen of it."""
    way = (np.array(ends) - storey.in_plan(face.origin)) @ storey.in_plan(face.along)
    return covered_length(face.extended, float(way.min()), float(way.max())) / float(np.ptp(way))


def _border(own: Sequence[_Edge], edges: Sequence[_Edge], joined: np.ndarray) -> list[_Edge]:
    """The edges of a room's cells that are not inside it."""
    rooms = {(edge.start, edge.end): joined[edge.cell] for edge in edges}
    return [edge for edge in own if rooms.get((edge.end, edge.start), -1) != joined[edge.cell]]


def _is_room(border: Sequence[_Edge], inside: BaseGeometry, storey: Storey, walls: Sequence[Face]) -> bool:
    """Closed, wide enough, and seen from inside: no side of any length is the back of a face."""
    if any(edge.face < 0 for edge in border) or inside.buffer(-THICKEST_M / 2.0).is_empty:
        return False
    for edge in border:
        face = walls[edge.face]
        way = np.array(edge.end) - np.array(edge.start)
        if way @ storey.in_plan(face.along) < -SHORT_M:
            return False
    return True


def _rings(border: Sequence[_Edge]) -> list[list[int]]:
    """The border as rings of faces, each face once in a row, the longest ring first."""
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
    rings.sort(key=lambda ring: -sum(np.hypot(*np.subtract(edge.end, edge.start)) for edge in ring))
    return [_sides([edge.face for edge in ring]) for ring in rings]


def _take(leaving: dict[Node, list[_Edge]], node: Node, coming: _Edge | None) -> _Edge | None:
    """The edge to go on with; where the border touches itself, the one most to the right keeps rings apart."""
    choice = leaving.get(node)
    if not choice:
        return None
    best = 0 if coming is None else int(np.argmin([_turn(coming, edge) for edge in choice]))
    edge = choice.pop(best)
    if not choice:
        del leaving[node]
    return edge


def _turn(coming: _Edge, going: _Edge) -> float:
    """Turn to the left from one edge to the next, rad."""
    (ax, ay), (bx, by) = np.subtract(coming.end, coming.start), np.subtract(going.end, going.start)
    return float(np.arctan2(ax * by - ay * bx, ax * bx + ay * by))


def _sides(faces: list[int]) -> list[int]:
    """Without repetitions in a row, the end and the beginning being neighbours."""
    return [face for k, face in enumerate(faces) if face != faces[k - 1]]
