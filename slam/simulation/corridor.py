"""A corridor like the paper's: 2.268 m wide, 2.700 m high, with everything that stands and hangs in it."""

from __future__ import annotations

from slam.simulation.walls import Wall, add_wall, features_along
from slam.simulation.world import World, WorldBuilder

#: Measured by hand in the paper, m.
WIDTH_M, HEIGHT_M = 2.268, 2.700
#: The corridor begins this far behind the robot's start and ends this far beyond the end of its way, m.
BEHIND_M, OUTLINE_GAP_SCALE_M = 2.0, 3.0
#: The way of the paper's 1083 scans, m: shorter missions drive in the same corridor.
SHORTEST_WAY_M = 29.3

#: What stands along each wall, again and again: kind, gap before it, length along the wall, m.
_LEFT = (("locker", 1.1, 3.0), ("door", 0.8, 0.95), ("board", 1.0, 1.5), ("door", 1.2, 0.95), ("closet", 0.7, 1.0))
_RIGHT = (("door", 1.6, 0.95), ("board", 0.9, 1.2), ("chamber", 1.3, 0.95), ("locker", 0.8, 2.4), ("board", 1.0, 0.9))


def corridor(way_m: float) -> World:
    """The corridor along x for a robot that drives `way_m` from the origin, its axis at y = 0, the floor at z = 0."""
    builder = WorldBuilder()
    start, end = -BEHIND_M, max(way_m, SHORTEST_WAY_M) + OUTLINE_GAP_SCALE_M
    half, length = WIDTH_M / 2.0, end - start
    inside = (0.0, 0.0, HEIGHT_M / 2.0)
    floor = builder.add_patch((start, -half, 0.0), (length, 0, 0), (0, WIDTH_M, 0), toward=inside)
    builder.add_patch((start, -half, HEIGHT_M), (length, 0, 0), (0, WIDTH_M, 0), toward=inside)
    for side, pattern in ((1.0, _LEFT), (-1.0, _RIGHT)):
        wall = Wall((start, side * half), (1.0, 0.0), (0.0, -side), length, HEIGHT_M)
        add_wall(builder, wall, features_along(length, pattern), floor)
    for x in (start, end):
        builder.add_patch((x, -half, 0.0), (0, WIDTH_M, 0), (0, 0, HEIGHT_M), toward=inside)
    _add_ceiling(builder, start, end)
    return builder.build()


def _add_ceiling(builder: WorldBuilder, start: float, end: float) -> None:
    """Neon lamps along the middle, round steel beams from wall to wall, both just under the ceiling."""
    x = start + 1.5
    while x + 1.5 < end:
        builder.add_box((x, -0.12, HEIGHT_M - 0.10), (x + 1.3, 0.12, HEIGHT_M), hidden=["z+"])
        builder.add_bar((x + 2.4, -WIDTH_M / 2.0, HEIGHT_M - 0.25), (x + 2.4, WIDTH_M / 2.0, HEIGHT_M - 0.25), 0.07)
        x += 4.0
