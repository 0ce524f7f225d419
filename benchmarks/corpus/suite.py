"""An office suite to measure: a corridor and rooms on both sides that the robot enters, walls with two faces."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from benchmarks.corpus.polygon_world import PolygonBuilder, PolygonWorld
from slam.simulation.robots import Path
from spplanes._check import FloatArray

#: Radius the robot takes its corners with, and the way it keeps from where it turns to the doors' wall, m.
_TURN_M, _INSIDE_M = 0.25, 0.7
#: Faces that look the same way are in one plane or further apart than this, m.
_APART_M = 0.1
#: Where the corridor ends behind the origin, m.
_BEHIND_M = -1.5
#: Where the robot starts, x, m: its first pose there heads along x.
START_M = -1.0


@dataclass(frozen=True)
class Door:
    """A doorway without a leaf, in the wall between the corridor and a room: from where to where along x, m."""

    start_m: float
    end_m: float
    height_m: float  # of its lintel above the floor, m

    @property
    def width_m(self) -> float:
        """Between its jambs, m."""
        return self.end_m - self.start_m


@dataclass(frozen=True)
class SuiteRoom:
    """A rectangle of free space, its faces along x and y: from its lowest corner (x0, y0) to its highest, m."""

    x0: float
    y0: float
    x1: float
    y1: float
    door: Door | None = None  # the doorway to the corridor; None for the corridor itself

    @property
    def door_x(self) -> float:
        """Middle of the doorway, m."""
        assert self.door is not None
        return (self.door.start_m + self.door.end_m) / 2.0

    @property
    def width_m(self) -> float:
        """Along x, m."""
        return self.x1 - self.x0

    @property
    def depth_m(self) -> float:
        """Along y, m."""
        return self.y1 - self.y0

    @property
    def area_m2(self) -> float:
        """Floor area, m^2."""
        return self.width_m * self.depth_m


@dataclass(frozen=True, eq=False)
class Suite:
    """The truth of a suite."""

    corridor: SuiteRoom
    rooms: tuple[SuiteRoom, ...]  # those above the corridor, which is along x, first, each by ascending x
    wall_m: float  # thickness of the walls between corridor and rooms, m
    partition_m: float  # thickness of the walls between rooms, m
    height_m: float  # of the ceiling above the floor, m

    @classmethod
    def drawn(cls, rng: np.random.Generator, *, rooms_a_side: int = 2) -> Self:
        """A suite of random measures; the robot starts 1 m behind the origin, in the middle of the corridor."""
        while True:
            suite = cls._drawn(rng, rooms_a_side)
            above, below = suite.rooms[rooms_a_side - 1], suite.rooms[-1]
            if abs(above.door_x - below.door_x) > 2.0 * _TURN_M and suite._faces_are_apart():
                return suite

    def _faces_are_apart(self) -> bool:
        """Whether faces that look the same way are one plane, or further apart than what could be taken for one."""
        spaces = (self.corridor, *self.rooms)
        faces = ([getattr(room, side) for room in spaces] for side in ("x0", "y0", "x1", "y1"))
        return not any(np.any(np.diff(np.unique(places)) < _APART_M) for places in faces)

    @classmethod
    def _drawn(cls, rng: np.random.Generator, rooms_a_side: int) -> Self:
        half, wall, partition = (float(rng.uniform(*span)) for span in ((0.9, 1.2), (0.12, 0.3), (0.1, 0.2)))
        rooms, ends = [], []
        for side in (1.0, -1.0):
            x = _BEHIND_M
            for _ in range(rooms_a_side):
                width, depth, opening = (float(rng.uniform(*span)) for span in ((3.0, 4.5), (3.0, 4.5), (0.85, 1.1)))
                start = float(x + rng.uniform(0.5, width - 0.5 - opening))
                near, far = half + wall, half + wall + depth
                low, high = (near, far) if side > 0.0 else (-far, -near)
                rooms.append(SuiteRoom(x, low, x + width, high, Door(start, start + opening, 2.05)))
                x += width + partition
            ends.append(x - partition)
        corridor = SuiteRoom(_BEHIND_M, -half, max(ends) + float(rng.uniform(0.0, 0.5)), half)
        return cls(corridor, tuple(rooms), wall, partition, float(rng.uniform(2.5, 3.0)))

    def room_at(self, x: float, y: float) -> SuiteRoom:
        """The room, or the corridor, that a place is in."""
        for room in (self.corridor, *self.rooms):
            if room.x0 < x < room.x1 and room.y0 < y < room.y1:
                return room
        raise ValueError(f"x, y: expected a place in a room of the suite, got {x:.2f}, {y:.2f}")

    def door_at(self, x: float, y: float) -> Door:
        """The doorway nearest to a place, on its side of the corridor."""
        doors = [room.door for room in self.rooms if room.door is not None and room.y0 * y > 0.0]
        return min(doors, key=lambda door: abs(door.start_m + door.end_m - 2.0 * x))

    def world(self, floor_m: float = 0.0) -> PolygonWorld:
        """Its surfaces, with the floor at a height: floor and ceiling one plane each, every face of a wall one."""
        builder = PolygonBuilder()
        spaces = [self.corridor, *self.rooms]
        levels: list[int | None] = [None, None]
        for room in spaces:
            for k, z in enumerate((0.0, self.height_m)):
                ring = _level(room.x0, room.y0, room.x1, room.y1, floor_m + z)
                levels[k] = builder.add_polygon([ring], toward=(0.0, 0.0, floor_m + 1.0), plane=levels[k])
        for room in self.rooms:
            self._add_doorway(builder, room, floor_m, levels[0])
        for room in spaces:
            for side in range(4):
                self._add_face(builder, room, side, floor_m)
        return builder.build()

    def _add_face(self, builder: PolygonBuilder, room: SuiteRoom, side: int, floor_m: float) -> None:
        """One of the four walls of a room, with a notch for every doorway in it."""
        along_x, at = side < 2, (room.y0, room.y1, room.x0, room.x1)[side]
        start, end = (room.x0, room.x1) if along_x else (room.y0, room.y1)
        outline = [(start, 0.0)]
        doors = [one.door for one in self.rooms if one.door is not None and along_x and at in self._behind(one)]
        for door in sorted(doors, key=lambda one: one.start_m):
            if start <= door.start_m and door.end_m <= end:
                outline += [(door.start_m, 0.0), (door.start_m, door.height_m), (door.end_m, door.height_m)]
                outline.append((door.end_m, 0.0))
        outline += [(end, 0.0), (end, self.height_m), (start, self.height_m)]
        ring = [(s, at, floor_m + z) if along_x else (at, s, floor_m + z) for s, z in outline]
        middle = ((room.x0 + room.x1) / 2.0, (room.y0 + room.y1) / 2.0, floor_m + 1.0)
        builder.add_polygon([ring], toward=middle)

    def _behind(self, room: SuiteRoom) -> tuple[float, float]:
        """Both faces of the wall between a room and the corridor, y, m, the lower one first."""
        return (self.corridor.y1, room.y0) if room.y0 > 0.0 else (room.y1, self.corridor.y0)

    def _add_doorway(self, builder: PolygonBuilder, room: SuiteRoom, floor_m: float, floor: int | None) -> None:
        door = room.door
        assert door is not None
        (low, high), top = self._behind(room), floor_m + door.height_m
        middle: Any = (room.door_x, (low + high) / 2.0, floor_m + 1.0)
        builder.add_polygon([_level(door.start_m, low, door.end_m, high, floor_m)], toward=middle, plane=floor)
        builder.add_polygon([_level(door.start_m, low, door.end_m, high, top)], toward=middle)
        for x in (door.start_m, door.end_m):
            ring = np.array([(x, low, floor_m), (x, high, floor_m), (x, high, top), (x, low, top)])
            builder.add_polygon([ring], toward=middle)

    def path(self) -> Path:
        """Along the corridor, into every room above it, round in it and out again; back by those below it."""
        half = len(self.rooms) // 2
        points = [(START_M, 0.0)]
        for room in (*self.rooms[:half], *self.rooms[: half - 1 : -1]):
            x, side = room.door_x, np.sign(room.y0)
            near = room.y0 if side > 0.0 else room.y1
            turn = x + (0.9 if room.x1 - x > x - room.x0 else -0.9)
            inner, outer = near + side * _INSIDE_M, near + side * (_INSIDE_M + 1.0)
            points += [(x, 0.0), (x, outer), (turn, outer), (turn, inner), (x, inner), (x, 0.0)]
        return Path.rounded([*points, (START_M, 0.0)], _TURN_M)


def _level(x0: float, y0: float, x1: float, y1: float, z: float) -> FloatArray:
    return np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)])
