"""Walls and what is in them, on them and behind them: doors, doorways, rooms, lockers, closets, notice-boards."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from slam.simulation.world import Hole, WorldBuilder

DOOR_WIDTH_M, DOOR_HEIGHT_M = 0.95, 2.05
#: How far a closed door is set back, and how thick the walls between corridors and rooms are, m.
_DOOR_DEPTH_M, _WALL_THICKNESS_M = 0.12, 0.12
#: Depth of the narrow closed chamber behind an open doorway, m.
_CHAMBER_DEPTH_M = 2.5
#: Width along the wall, depth and height of a room behind a doorway, m.
_ROOM_WIDTH_M, _ROOM_DEPTH_M, _ROOM_HEIGHT_M = 4.0, 3.5, 2.5
#: What stands or hangs against a wall: depth out of it, bottom, top, m.
_BLOCKS = {"locker": (0.05, 0.0, 1.9), "closet": (0.40, 0.0, 2.1), "board": (0.02, 1.0, 2.0)}
#: Openings in the wall.
_OPENINGS = ("door", "chamber", "room")

Point = tuple[float, float, float]


class Feature(NamedTuple):
    """Something in or on a wall."""

    kind: str
    """door, chamber, room (all openings), locker, closet, board."""
    start_m: float
    """Where it begins along the wall, m."""
    end_m: float
    """Where it ends along the wall, m."""


@dataclass(frozen=True)
class Wall:
    """A straight wall along x or y, from the floor up, seen from one side."""

    start: tuple[float, float]
    """Where it begins, m."""
    along: tuple[float, float]
    """Unit direction it runs in, along x or y."""
    inward: tuple[float, float]
    """Unit direction to the side it is seen from."""
    length_m: float
    """Its length, m."""
    height_m: float
    """Its height, m."""

    def point(self, s: float, n: float, z: float) -> Point:
        """The point `s` along the wall, `n` in front of it and `z` above the floor."""
        x = self.start[0] + s * self.along[0] + n * self.inward[0]
        y = self.start[1] + s * self.along[1] + n * self.inward[1]
        return (x, y, z)

    def across(self, s: float, n: float, z: float) -> Point:
        """The vector of `s` along, `n` inward and `z` up."""
        return (s * self.along[0] + n * self.inward[0], s * self.along[1] + n * self.inward[1], z)


def features_along(length_m: float, pattern: Sequence[tuple[str, float, float]]) -> list[Feature]:
    """Repeat a pattern of (kind, gap before it, length) along a wall, m, as far as it fits."""
    placed: list[Feature] = []
    s = 0.0
    while True:
        kind, gap, length = pattern[len(placed) % len(pattern)]
        if s + gap + length > length_m - 0.5:
            return placed
        placed.append(Feature(kind, s + gap, s + gap + length))
        s += gap + length


def add_wall(builder: WorldBuilder, wall: Wall, features: Sequence[Feature], floor: int) -> None:
    """Add the wall, its openings as holes, and everything on it and behind it; floors behind it enlarge `floor`."""
    holes: list[Hole] = [(f.start_m, 0.0, f.end_m, DOOR_HEIGHT_M) for f in features if f.kind in _OPENINGS]
    corner, seen_from = wall.point(0.0, 0.0, 0.0), wall.point(0.0, 1.0, 1.0)
    u, v = wall.across(wall.length_m, 0.0, 0.0), (0.0, 0.0, wall.height_m)
    builder.add_patch(corner, u, v, toward=seen_from, holes=holes)
    for feature in features:
        if feature.kind in _BLOCKS:
            _add_block(builder, wall, feature)
        elif feature.kind == "room":
            _add_room(builder, wall, feature, floor)
        else:
            depth = _DOOR_DEPTH_M if feature.kind == "door" else _CHAMBER_DEPTH_M
            _add_passage(builder, wall, feature, floor, depth, closed=True)


def _add_passage(
    builder: WorldBuilder, wall: Wall, feature: Feature, floor: int, depth: float, *, closed: bool
) -> None:
    """The sides, lintel and floor of an opening of some depth, and its far end if it is closed."""
    a, b = feature.start_m, feature.end_m
    middle = wall.point((a + b) / 2.0, -depth / 2.0, DOOR_HEIGHT_M / 2.0)
    up, back, along = (0.0, 0.0, DOOR_HEIGHT_M), wall.across(0.0, -depth, 0.0), wall.across(b - a, 0.0, 0.0)
    if closed:
        builder.add_patch(wall.point(a, -depth, 0.0), along, up, toward=middle)
    for s in (a, b):
        builder.add_patch(wall.point(s, 0.0, 0.0), back, up, toward=middle)
    builder.add_patch(wall.point(a, 0.0, 0.0), along, back, toward=middle, plane=floor)
    builder.add_patch(wall.point(a, 0.0, DOOR_HEIGHT_M), along, back, toward=middle)


def _add_block(builder: WorldBuilder, wall: Wall, feature: Feature) -> None:
    """Lockers, a closet or a notice-board: a box against the wall."""
    depth, bottom, top = _BLOCKS[feature.kind]
    ends = (wall.point(feature.start_m, 0.0, bottom), wall.point(feature.end_m, depth, top))
    low, high = ([f(pair) for pair in zip(*ends, strict=True)] for f in (min, max))
    axis = 0 if wall.inward[0] else 1
    hidden = ["xy"[axis] + ("-" if wall.inward[axis] > 0.0 else "+")]
    builder.add_box(low, high, hidden=hidden if bottom > 0.0 else [*hidden, "z-"])


def _add_room(builder: WorldBuilder, wall: Wall, feature: Feature, floor: int) -> None:
    """An open doorway and a room behind it with a cupboard and a round pillar."""
    _add_passage(builder, wall, feature, floor, _WALL_THICKNESS_M, closed=False)
    centre = (feature.start_m + feature.end_m) / 2.0
    a, b = centre - _ROOM_WIDTH_M / 2.0, centre + _ROOM_WIDTH_M / 2.0
    near, far = -_WALL_THICKNESS_M, -_WALL_THICKNESS_M - _ROOM_DEPTH_M
    middle = wall.point(centre, (near + far) / 2.0, _ROOM_HEIGHT_M / 2.0)
    up, along, back = (0.0, 0.0, _ROOM_HEIGHT_M), wall.across(b - a, 0.0, 0.0), wall.across(0.0, far - near, 0.0)
    doorway: Hole = (feature.start_m - a, 0.0, feature.end_m - a, DOOR_HEIGHT_M)
    builder.add_patch(wall.point(a, near, 0.0), along, up, toward=middle, holes=[doorway])
    builder.add_patch(wall.point(a, far, 0.0), along, up, toward=middle)
    for s in (a, b):
        builder.add_patch(wall.point(s, near, 0.0), back, up, toward=middle)
    builder.add_patch(wall.point(a, near, 0.0), along, back, toward=middle, plane=floor)
    builder.add_patch(wall.point(a, near, _ROOM_HEIGHT_M), along, back, toward=middle)
    back_wall = Wall(wall.point(a, far, 0.0)[:2], wall.along, wall.inward, b - a, _ROOM_HEIGHT_M)
    _add_block(builder, back_wall, Feature("closet", 0.6, 2.2))
    builder.add_bar(back_wall.point(3.2, 0.8, 0.0), back_wall.point(3.2, 0.8, _ROOM_HEIGHT_M), 0.15)
