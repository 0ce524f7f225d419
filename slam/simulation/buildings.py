"""Buildings to drive through: a corridor like the paper's, an office and a hall; their walls and doors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import NamedTuple

import numpy as np

from slam.simulation.robots import Path
from slam.simulation.world import Hole, World, WorldBuilder

DOOR_HEIGHT_M = 2.05
#: What stands or hangs against a wall: depth out of it, bottom, top, m.
_BLOCKS = {"locker": (0.05, 0.0, 1.9), "closet": (0.40, 0.0, 2.1), "board": (0.02, 1.0, 2.0)}
#: Openings in the wall: how deep the closed space is behind a doorway, m; None: there is a room.
_OPENINGS = {"door": 0.12, "chamber": 2.5, "room": None}

Point = tuple[float, float, float]
Span = tuple[float, float]


class Feature(NamedTuple):
    """Something in or on a wall, between two places along it: one of `_BLOCKS` or of `_OPENINGS`."""

    kind: str
    start_m: float
    end_m: float


@dataclass(frozen=True)
class Wall:
    """A straight wall in the unit direction `along` x or y, from the floor up, seen from its `inward` side."""

    start: tuple[float, float]
    along: tuple[float, float]
    inward: tuple[float, float]
    length_m: float
    height_m: float

    def point(self, s: float, n: float, z: float) -> Point:
        """The point `s` along the wall, `n` in front of it and `z` above the floor."""
        x, y = (a + s * b + n * c for a, b, c in zip(self.start, self.along, self.inward, strict=True))
        return (x, y, z)

    def across(self, s: float, n: float, z: float) -> Point:
        """The vector of `s` along, `n` inward and `z` up."""
        x, y = (s * a + n * b for a, b in zip(self.along, self.inward, strict=True))
        return (x, y, z)


def features_along(length_m: float, pattern: Sequence[tuple[str, float, float]]) -> list[Feature]:
    """Repeat a pattern of (kind, gap before it, length) along a wall, m, as far as it fits."""
    placed: list[Feature] = []
    s = 0.0
    for kind, gap, length in cycle(pattern):
        if s + gap + length > length_m - 0.5:
            break
        placed.append(Feature(kind, s + gap, s + gap + length))
        s += gap + length
    return placed


def add_wall(builder: WorldBuilder, wall: Wall, features: Sequence[Feature], floor: int) -> None:
    """Add the wall, its openings as holes, and everything on it and behind it; floors behind it enlarge `floor`."""
    holes: list[Hole] = [(f.start_m, 0.0, f.end_m, DOOR_HEIGHT_M) for f in features if f.kind in _OPENINGS]
    corner, seen_from = wall.point(0.0, 0.0, 0.0), wall.point(0.0, 1.0, 1.0)
    u, v = wall.across(wall.length_m, 0.0, 0.0), (0.0, 0.0, wall.height_m)
    builder.add_patch(corner, u, v, toward=seen_from, holes=holes)
    for feature in features:
        if feature.kind in _BLOCKS:
            _add_block(builder, wall, feature)
        elif (depth := _OPENINGS[feature.kind]) is None:
            _add_room(builder, wall, feature, floor)
        else:
            _add_cell(builder, wall, (feature.start_m, feature.end_m), (0.0, -depth), DOOR_HEIGHT_M, floor)


def _add_cell(
    builder: WorldBuilder, wall: Wall, span: Span, depth: Span, height: float, floor: int, closed: bool = True
) -> None:
    """What is seen from inside of a space in or behind a wall: its far end if it is closed, sides, floor, ceiling."""
    (a, b), (near, far) = span, depth
    middle = wall.point((a + b) / 2.0, (near + far) / 2.0, height / 2.0)
    up, along, back = (0.0, 0.0, height), wall.across(b - a, 0.0, 0.0), wall.across(0.0, far - near, 0.0)
    if closed:
        builder.add_patch(wall.point(a, far, 0.0), along, up, toward=middle)
    for s in span:
        builder.add_patch(wall.point(s, near, 0.0), back, up, toward=middle)
    builder.add_patch(wall.point(a, near, 0.0), along, back, toward=middle, plane=floor)
    builder.add_patch(wall.point(a, near, height), along, back, toward=middle)


def _add_block(builder: WorldBuilder, wall: Wall, feature: Feature) -> None:
    """Lockers, a closet or a notice-board: a box against the wall."""
    depth, bottom, top = _BLOCKS[feature.kind]
    ends = (wall.point(feature.start_m, 0.0, bottom), wall.point(feature.end_m, depth, top))
    low, high = ([f(pair) for pair in zip(*ends, strict=True)] for f in (min, max))
    axis = 0 if wall.inward[0] else 1
    hidden = ["xy"[axis] + ("-" if wall.inward[axis] > 0.0 else "+")]
    builder.add_box(low, high, hidden=hidden if bottom > 0.0 else [*hidden, "z-"])


def _add_room(builder: WorldBuilder, wall: Wall, feature: Feature, floor: int) -> None:
    """An open doorway in a wall of 0.12 m, and a room of 4 x 3.5 x 2.5 m with a cupboard and a round pillar."""
    door, height = (feature.start_m, feature.end_m), 2.5
    near, far = -0.12, -0.12 - 3.5
    _add_cell(builder, wall, door, (0.0, near), DOOR_HEIGHT_M, floor, closed=False)
    centre = (door[0] + door[1]) / 2.0
    a, b = centre - 2.0, centre + 2.0
    along, up = wall.across(b - a, 0.0, 0.0), (0.0, 0.0, height)
    doorway: Hole = (door[0] - a, 0.0, door[1] - a, DOOR_HEIGHT_M)
    builder.add_patch(wall.point(a, near, 0.0), along, up, toward=wall.point(centre, far, 1.0), holes=[doorway])
    _add_cell(builder, wall, (a, b), (near, far), height, floor)
    back_wall = Wall(wall.point(a, far, 0.0)[:2], wall.along, wall.inward, b - a, height)
    _add_block(builder, back_wall, Feature("closet", 0.6, 2.2))
    builder.add_bar(back_wall.point(3.2, 0.8, 0.0), back_wall.point(3.2, 0.8, height), 0.15)


#: What stands along each wall, again and again: kind, gap before it, length along the wall, m.
_LEFT = (("locker", 1.1, 3.0), ("door", 0.8, 0.95), ("board", 1.0, 1.5), ("door", 1.2, 0.95), ("closet", 0.7, 1.0))
_RIGHT = (("door", 1.6, 0.95), ("board", 0.9, 1.2), ("chamber", 1.3, 0.95), ("locker", 0.8, 2.4), ("board", 1.0, 0.9))


def corridor(way_m: float) -> World:
    """The corridor along x for a robot that drives `way_m` from the origin, its axis at y = 0, the floor at z = 0.

    It is never shorter than the way of the paper's 1083 scans needs, 29.3 m.
    """
    builder = WorldBuilder()
    width, height = 2.268, 2.700  # measured by hand in the paper, m
    start, end = -2.0, max(way_m, 29.3) + 3.0
    half, length = width / 2.0, end - start
    inside = (0.0, 0.0, height / 2.0)
    floor = builder.add_patch((start, -half, 0.0), (length, 0, 0), (0, width, 0), toward=inside)
    builder.add_patch((start, -half, height), (length, 0, 0), (0, width, 0), toward=inside)
    for side, pattern in ((1.0, _LEFT), (-1.0, _RIGHT)):
        wall = Wall((start, side * half), (1.0, 0.0), (0.0, -side), length, height)
        add_wall(builder, wall, features_along(length, pattern), floor)
    for x in (start, end):
        builder.add_patch((x, -half, 0.0), (0, width, 0), (0, 0, height), toward=inside)
    for x in np.arange(start + 1.5, end - 1.5, 4.0).tolist():  # lamps, and round steel beams, just under the ceiling
        builder.add_box((x, -0.12, height - 0.10), (x + 1.3, 0.12, height), hidden=["z+"])
        builder.add_bar((x + 2.4, -half, height - 0.25), (x + 2.4, half, height - 0.25), 0.07)
    return builder.build()


def room() -> World:
    """A closed room around the origin, 8 x 6 m: walls, two corners cut off, a cupboard, a table leg, a round pillar."""
    builder = WorldBuilder()
    x, y, height, cut = 4.0, 3.0, 2.6, 1.5
    middle, up = (0.0, 0.0, height / 2.0), (0.0, 0.0, height)
    outline = [(-x, -y), (x - cut, -y), (x, -y + cut), (x, y), (-x + cut, y), (-x, y - cut)]
    for a, b in zip(outline, [*outline[1:], outline[0]], strict=True):
        builder.add_patch((*a, 0.0), (b[0] - a[0], b[1] - a[1], 0.0), up, toward=middle)
    for z in (0.0, height):
        builder.add_patch((-x, -y, z), (2.0 * x, 0, 0), (0, 2.0 * y, 0), toward=middle)
    builder.add_box((-x, 0.2, 0.0), (-x + 0.5, 1.4, 1.9), hidden=["x-", "z-"])
    builder.add_box((2.2, 1.6, 0.0), (2.6, 2.0, 1.2), hidden=["z-"])
    builder.add_bar((-1.8, -2.0, 0.0), (-1.8, -2.0, height), 0.2)
    return builder.build()


def hall() -> World:
    """A closed hall, 30 x 20 m: gables, a roof of two slopes, two rows of square pillars, crates and round columns."""
    builder = WorldBuilder()
    x, y, height, ridge = 15.0, 10.0, 6.0, 8.0
    middle = (0.0, 0.0, height / 2.0)
    builder.add_patch((-x, -y, 0.0), (2.0 * x, 0, 0), (0, 2.0 * y, 0), toward=middle)
    for side in (-1.0, 1.0):
        builder.add_patch((-x, side * y, 0.0), (2.0 * x, 0, 0), (0, 0, height), toward=middle)
        builder.add_patch((-x, side * y, height), (2.0 * x, 0, 0), (0, -side * y, ridge - height), toward=middle)
        builder.add_patch((side * x, -y, 0.0), (0, 2.0 * y, 0), (0, 0, ridge), toward=middle)
    for place in np.linspace(-10.0, 10.0, 5):
        for side in (-5.0, 5.0):
            builder.add_box((place - 0.3, side - 0.3, 0.0), (place + 0.3, side + 0.3, ridge), hidden=["z-", "z+"])
    for k, (a, b) in enumerate([(-12.0, -8.0), (-3.0, 8.0), (4.0, -8.5), (12.0, 7.0)]):
        builder.add_box((a, b, 0.0), (a + 1.5 + 0.3 * k, b + 1.2, 1.0 + 0.3 * k), hidden=["z-"])
        builder.add_bar((a - 1.0, b, 0.0), (a - 1.0, b, ridge), 0.25)
    return builder.build()


#: Corners of the rectangle along the middle of the corridors, m; the robot starts at the origin, heading along x.
LEFT_M, RIGHT_M, BOTTOM_M, TOP_M = -8.0, 18.0, 0.0, 14.0
#: Width and height of the corridors, m.
OFFICE_WIDTH_M, OFFICE_HEIGHT_M = 2.2, 2.7

#: Features of the eight walls, outer then inner, anticlockwise from the bottom: kind, start, end along the wall, m.
_OUTER = (
    (("room", 3.0, 3.95), ("board", 6.5, 7.7), ("room", 10.0, 10.95), ("locker", 14.0, 17.0), ("room", 21.0, 21.95)),
    (("door", 3.0, 3.95), ("room", 7.5, 8.45), ("closet", 11.5, 12.5)),
    (("room", 4.0, 4.95), ("locker", 8.0, 10.4), ("door", 12.0, 12.95), ("room", 16.5, 17.45), ("door", 22.0, 22.95)),
    (("board", 2.5, 4.0), ("room", 6.0, 6.95), ("door", 11.0, 11.95)),
)
_INNER = (
    (("door", 2.0, 2.95), ("room", 6.0, 6.95), ("locker", 10.0, 12.4), ("room", 15.0, 15.95), ("board", 19.0, 20.2)),
    (("board", 2.0, 3.2), ("door", 6.0, 6.95)),
    (("room", 4.0, 4.95), ("closet", 8.5, 9.5), ("door", 12.0, 12.95), ("room", 17.0, 17.95)),
    (("locker", 2.0, 4.4), ("door", 7.0, 7.95)),
)


def office() -> World:
    """The ring with its rooms."""
    builder = WorldBuilder()
    half = OFFICE_WIDTH_M / 2.0
    outer = (LEFT_M - half, RIGHT_M + half, BOTTOM_M - half, TOP_M + half)
    inner = (LEFT_M + half, RIGHT_M - half, BOTTOM_M + half, TOP_M - half)
    size = (outer[1] - outer[0], outer[3] - outer[2])
    block = (OFFICE_WIDTH_M, OFFICE_WIDTH_M, size[0] - OFFICE_WIDTH_M, size[1] - OFFICE_WIDTH_M)
    levels = [
        builder.add_patch((outer[0], outer[2], z), (size[0], 0, 0), (0, size[1], 0), toward=(0, 0, 1), holes=[block])
        for z in (0.0, OFFICE_HEIGHT_M)
    ]
    for rectangle, features, side in ((outer, _OUTER, 1.0), (inner, _INNER, -1.0)):
        for wall, on_it in zip(_walls(rectangle, side), features, strict=True):
            add_wall(builder, wall, [Feature(*f) for f in on_it], floor=levels[0])
    for k in range(6):
        x = LEFT_M + 2.0 + 4.0 * k
        for y in (BOTTOM_M, TOP_M):
            builder.add_box((x, y - 0.12, OFFICE_HEIGHT_M - 0.10), (x + 1.3, y + 0.12, OFFICE_HEIGHT_M), hidden=["z+"])
    return builder.build()


def _walls(rectangle: tuple[float, float, float, float], side: float) -> list[Wall]:
    """The walls of a rectangle (x0, x1, y0, y1), anticlockwise from the bottom, seen from inside (+1) or outside."""
    x0, x1, y0, y1 = rectangle
    width, depth = x1 - x0, y1 - y0
    return [
        Wall((x0, y0), (1.0, 0.0), (0.0, side), width, OFFICE_HEIGHT_M),
        Wall((x1, y0), (0.0, 1.0), (-side, 0.0), depth, OFFICE_HEIGHT_M),
        Wall((x1, y1), (-1.0, 0.0), (0.0, -side), width, OFFICE_HEIGHT_M),
        Wall((x0, y1), (0.0, -1.0), (side, 0.0), depth, OFFICE_HEIGHT_M),
    ]


#: Worlds that are a loop: x low, x high and y of the far side of the way round, the radius of its corners, and how far
#: it goes on beyond where it began, m.
LOOPS = {
    "office": (office, LEFT_M, RIGHT_M, TOP_M, 0.8, 2.0),
    "room": (room, -1.8, 1.5, 1.2, 0.5, 0.5),
    "hall": (hall, -12.0, 11.5, 6.5, 1.5, 1.0),  # between the rows of pillars and the walls
}


def loop_path(world: str, laps: int) -> Path:
    """The way through a world that is a loop, so many times, anticlockwise from the origin."""
    _, left, right, top, radius_m, beyond = LOOPS[world]
    corners = [(right, 0.0), (right, top), (left, top), (left, 0.0)]
    return Path.rounded([(0.0, 0.0), *(corners * laps), (beyond, 0.0)], radius_m)
