"""An office floor: a ring of corridors, about 79 m round, with rooms on both sides."""

from __future__ import annotations

from slam.simulation.path import Path
from slam.simulation.walls import Feature, Wall, add_wall
from slam.simulation.world import World, WorldBuilder

#: Corners of the rectangle along the middle of the corridors, m; the robot starts at the origin, heading along x.
LEFT_M, RIGHT_M, BOTTOM_M, TOP_M = -8.0, 18.0, 0.0, 14.0
#: Width and height of the corridors, and the radius the robot takes its corners with, m.
WIDTH_M, HEIGHT_M, TURN_RADIUS_M = 2.2, 2.7, 0.8

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
    half = WIDTH_M / 2.0
    outer = (LEFT_M - half, RIGHT_M + half, BOTTOM_M - half, TOP_M + half)
    inner = (LEFT_M + half, RIGHT_M - half, BOTTOM_M + half, TOP_M - half)
    size = (outer[1] - outer[0], outer[3] - outer[2])
    block = (WIDTH_M, WIDTH_M, size[0] - WIDTH_M, size[1] - WIDTH_M)
    levels = [
        builder.add_patch((outer[0], outer[2], z), (size[0], 0, 0), (0, size[1], 0), toward=(0, 0, 1), holes=[block])
        for z in (0.0, HEIGHT_M)
    ]
    for rectangle, features, side in ((outer, _OUTER, 1.0), (inner, _INNER, -1.0)):
        for wall, on_it in zip(_walls(rectangle, side), features, strict=True):
            add_wall(builder, wall, [Feature(*f) for f in on_it], floor=levels[0])
    for k in range(6):
        x = LEFT_M + 2.0 + 4.0 * k
        for y in (BOTTOM_M, TOP_M):
            builder.add_box((x, y - 0.12, HEIGHT_M - 0.10), (x + 1.3, y + 0.12, HEIGHT_M), hidden=["z+"])
    return builder.build()


def _walls(rectangle: tuple[float, float, float, float], side: float) -> list[Wall]:
    """The walls of a rectangle (x0, x1, y0, y1), anticlockwise from the bottom, seen from inside (+1) or outside."""
    x0, x1, y0, y1 = rectangle
    width, depth = x1 - x0, y1 - y0
    return [
        Wall((x0, y0), (1.0, 0.0), (0.0, side), width, HEIGHT_M),
        Wall((x1, y0), (0.0, 1.0), (-side, 0.0), depth, HEIGHT_M),
        Wall((x1, y1), (-1.0, 0.0), (0.0, -side), width, HEIGHT_M),
        Wall((x0, y1), (0.0, -1.0), (side, 0.0), depth, HEIGHT_M),
    ]


def office_path(laps: int) -> Path:
    """Round the ring `laps` times, anticlockwise from the origin, and 2 m beyond where it began."""
    corners = [(RIGHT_M, BOTTOM_M), (RIGHT_M, TOP_M), (LEFT_M, TOP_M), (LEFT_M, BOTTOM_M)]
    return Path.rounded([(0.0, 0.0), *(corners * laps), (2.0, 0.0)], TURN_RADIUS_M)
