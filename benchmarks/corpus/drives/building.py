"""A building from its floor plan: walls along every edge of the free space, a roof of one or two slopes, furniture."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Self

import numpy as np
from numpy.random import Generator
from shapely import LineString, Point, Polygon, box
from shapely.affinity import rotate, translate
from shapely.geometry.polygon import orient

from benchmarks.corpus.polygon_world import GLASS, PolygonBuilder
from spplanes._check import FloatArray

#: Edges shorter than this are left over from set operations, m.
_NOTHING_M = 1e-6
#: Room that the robot needs about the middle of its way, m.
CLEAR_M = 0.55


@dataclass(frozen=True, eq=False)
class Roof:
    """A ceiling that is at each place the lowest of some planes z = a + b x + c y."""

    planes: FloatArray  # rows (a, b, c), one or two, shape (P, 3)

    @classmethod
    def flat(cls, height_m: float) -> Self:
        """Level."""
        return cls(np.array([[height_m, 0.0, 0.0]]))

    def of(self, plane: int, points: FloatArray) -> FloatArray:
        """Heights (N,) of one plane at points (N, 2), m."""
        return self.planes[plane, 0] + points @ self.planes[plane, 1:]

    def heights(self, points: FloatArray) -> FloatArray:
        """Height of the ceiling at points (N, 2), shape (N,), m."""
        return np.min([self.of(k, points) for k in range(len(self.planes))], axis=0)

    def cut(self, a: FloatArray, b: FloatArray) -> list[FloatArray]:
        """The points (2,) of a wall from a to b at which the ceiling bends, with both ends."""
        if len(self.planes) < 2:
            return [a, b]
        ends = np.array([a, b])
        first, last = self.of(0, ends) - self.of(1, ends)
        return [a, b] if first * last >= 0.0 else [a, a + first / (first - last) * (b - a), b]

    def part(self, plane: int, plan: Polygon) -> list[Polygon]:
        """The pieces of a floor plan over which one plane is the ceiling."""
        if len(self.planes) < 2:
            return [plan]
        pieces = plan.intersection(_half_plane(self.planes[plane] - self.planes[1 - plane]))
        return [one for one in getattr(pieces, "geoms", [pieces]) if isinstance(one, Polygon) and one.area > 1e-3]


def _half_plane(gap: FloatArray) -> Polygon:
    """Where a + b x + c y <= 0, as far as any plan reaches."""
    normal = gap[1:] / np.linalg.norm(gap[1:])
    foot, along, reach = -gap[0] / np.linalg.norm(gap[1:]) * normal, np.array([-normal[1], normal[0]]), 1e3
    ends = (foot + reach * along, foot - reach * along)
    return Polygon([*ends, ends[1] - reach * normal, ends[0] - reach * normal])


#: Of ring and edge of a plan the part that is glass from floor to ceiling, from and to as shares of the edge.
Panes = dict[tuple[int, int], tuple[float, float]]


def add_shell(builder: PolygonBuilder, plan: Polygon, roof: Roof, *, glass: Panes | None = None) -> None:
    """Floor, ceiling and walls of the free space `plan`; walls in one line with each other are one plane.

    The plan is seen from above, m; its holes are blocks to drive round.
    """
    plan, known = tidy(plan), {}
    rings = [np.array(ring.coords)[:-1] for ring in (plan.exterior, *plan.interiors)]
    builder.add_polygon([_at(ring, np.zeros(len(ring))) for ring in rings], toward=(*rings[0][0], 1.0))
    for k in range(len(roof.planes)):
        ceiling: int | None = None
        for piece in roof.part(k, plan):
            corners = [np.array(ring.coords)[:-1] for ring in (piece.exterior, *piece.interiors)]
            below = (*corners[0][0], float(roof.of(k, corners[0][:1])[0]) - 1.0)
            ceiling = builder.add_polygon([_at(c, roof.of(k, c)) for c in corners], toward=below, plane=ceiling)
    for r, ring in enumerate(rings):
        for e, (a, b) in enumerate(zip(ring, np.roll(ring, -1, axis=0), strict=True)):
            _add_wall(builder, a, b, roof, known, (glass or {}).get((r, e)))


def tidy(plan: Polygon) -> Polygon:
    """The plan with free space on the left of every edge, without corners that are none."""
    simple = plan.simplify(_NOTHING_M)
    assert isinstance(simple, Polygon)
    return orient(simple)


def _at(points: FloatArray, heights: FloatArray) -> FloatArray:
    return np.column_stack([points, heights])


def _add_wall(
    builder: PolygonBuilder,
    a: FloatArray,
    b: FloatArray,
    roof: Roof,
    known: dict[tuple[float, float, float], int],
    glass: tuple[float, float] | None,
) -> None:
    """A wall from a to b, free space on the left; `known` holds the planes of walls by their line."""
    along = (b - a) / np.linalg.norm(b - a)
    inward = np.array([-along[1], along[0]])
    line = (round(float(inward[0]), 6), round(float(inward[1]), 6), round(float(inward @ a), 5))
    for k, (start, end) in enumerate(pairwise([0.0, *(glass or ()), 1.0])):
        points = np.array(roof.cut(a + start * (b - a), a + end * (b - a)))
        low, high = _at(points[[0, -1]], np.zeros(2)), _at(points, roof.heights(points))[::-1]
        toward, transparent = (*(points.mean(axis=0) + inward), 1.0), glass is not None and k == 1
        plane = None if transparent else known.get(line)
        made = builder.add_polygon([np.vstack([low, high])], toward=toward, plane=plane, glass=transparent)
        if made != GLASS:
            known[line] = made


def add_furniture(
    builder: PolygonBuilder,
    plan: Polygon,
    way: LineString,
    rng: Generator,
    *,
    pieces: int,
    oblique: bool,
    poles: int = 0,
) -> None:
    """Boxes and poles about in the free space, clear of the way; half of the oblique boxes have a slanted top."""
    free = plan.buffer(-0.02).difference(way.buffer(CLEAR_M))
    for _ in range(pieces):
        footprint = _placed(free, rng, oblique=oblique)
        if footprint is None:
            continue
        free, height = free.difference(footprint.buffer(0.05)), rng.uniform(0.4, 1.9)
        rise = rng.uniform(-0.3, 0.3) if oblique and rng.random() < 0.5 else 0.0
        add_box(builder, footprint, height, height + rise * min(1.0, height))
    for _ in range(poles):
        spot = _spot(free, rng)
        if spot is not None:
            builder.add_bar((*spot, 0.0), (*spot, rng.uniform(1.0, 2.4)), rng.uniform(0.03, 0.2))


def _spot(free, rng: Generator) -> tuple[float, float] | None:
    low_x, low_y, high_x, high_y = free.bounds
    for _ in range(50):
        spot = float(rng.uniform(low_x, high_x)), float(rng.uniform(low_y, high_y))
        if free.contains(Point(spot)):
            return spot
    return None


def _placed(free, rng: Generator, *, oblique: bool) -> Polygon | None:
    """A rectangle somewhere in the free space; None where none fits."""
    for _ in range(20):
        spot = _spot(free, rng)
        if spot is None:
            return None
        width, depth = rng.uniform(0.3, 1.6), rng.uniform(0.3, 0.8)
        turn = rng.uniform(0.0, 180.0) if oblique else 0.0
        footprint = translate(rotate(box(-width / 2, -depth / 2, width / 2, depth / 2), turn), *spot)
        if free.contains(footprint):
            return footprint
    return None


def add_box(builder: PolygonBuilder, footprint: Polygon, front: float, back: float, *, foot: float = 0.0) -> None:
    """Four sides and a top that rises from the first edge of the footprint to the opposite one; `foot` is its height.

    Of one that hangs the underside too.
    """
    corners = np.array(orient(footprint).exterior.coords)[:4]
    top, middle = _at(corners, np.array([front, front, back, back])), corners.mean(axis=0)
    builder.add_polygon([top], toward=(*middle, 5.0))
    for a, b in ((0, 1), (1, 2), (2, 3), (3, 0)):
        side = np.array([(*corners[a], foot), (*corners[b], foot), top[b], top[a]])
        outside = corners[[a, b]].mean(axis=0) * 2.0 - middle
        builder.add_polygon([side], toward=(*outside, foot + 0.3))
    if foot > 0.0:
        builder.add_polygon([_at(corners, np.full(4, foot))], toward=(*middle, 0.0))
