"""The arrangement of wall lines: every wall as a line through the whole storey, and the cells they cut it into."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import shapely
from shapely.geometry.polygon import orient

from slam.floorplan.faces import ALIKE_RAD, Face, Interval, closed, covered_length
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
    """A side of a cell."""

    start: Node
    """From where."""
    end: Node
    """To where."""
    cell: int
    """The cell on its left."""
    line: int
    """Its line; -1 for the frame round all."""


def wall_lines(walls: Sequence[Face]) -> list[Line]:
    """The walls by line, those that were seen longest first."""
    left = sorted(range(len(walls)), key=lambda k: (-_seen_length(walls[k]), k))
    lines = []
    while left:
        base = walls[left[0]]
        members = [k for k in left if _is_in_line(walls[k], base)]
        left = [k for k in left if k not in members]
        spans = [base.beside(walls[k], span) for k in members for span in walls[k].extended]
        lines.append(Line(base, tuple(members), closed(spans, 0.0)))
    return lines


def _seen_length(face: Face) -> float:
    return sum(high - low for low, high in face.covered)


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
