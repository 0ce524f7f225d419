"""A corridor like the paper's: 2.268 m wide, 2.700 m high, with everything that stands and hangs in it."""

from __future__ import annotations

from slam.simulation.world import Hole, World, WorldBuilder

#: Measured by hand in the paper, m.
WIDTH_M, HEIGHT_M = 2.268, 2.700
#: The corridor begins this far behind the robot's start and ends this far beyond the end of its way, m.
BEHIND_M, BEYOND_M = 2.0, 3.0

_DOOR_WIDTH_M, _DOOR_HEIGHT_M, _DOOR_DEPTH_M = 0.95, 2.05, 0.12
#: What stands along each wall, again and again: kind, gap before it, length along the wall, m.
_LEFT = (("locker", 1.1, 3.0), ("door", 0.8, 0.95), ("board", 1.0, 1.5), ("door", 1.2, 0.95), ("closet", 0.7, 1.0))
_RIGHT = (("door", 1.6, 0.95), ("board", 0.9, 1.2), ("open", 1.3, 0.95), ("locker", 0.8, 2.4), ("board", 1.0, 0.9))


def corridor(way_m: float) -> World:
    """The corridor along x for a robot that drives `way_m` from the origin, its axis at y = 0, the floor at z = 0."""
    builder = WorldBuilder()
    start, end = -BEHIND_M, max(way_m, 29.3) + BEYOND_M
    half, length = WIDTH_M / 2.0, end - start
    inside = (0.0, 0.0, HEIGHT_M / 2.0)
    floor = builder.add_patch((start, -half, 0.0), (length, 0, 0), (0, WIDTH_M, 0), toward=inside)
    builder.add_patch((start, -half, HEIGHT_M), (length, 0, 0), (0, WIDTH_M, 0), toward=inside)
    for y, features in ((half, _LEFT), (-half, _RIGHT)):
        _add_wall(builder, start, end, y, features, floor)
    for x in (start, end):
        builder.add_patch((x, -half, 0.0), (0, WIDTH_M, 0), (0, 0, HEIGHT_M), toward=inside)
    _add_ceiling(builder, start, end)
    return builder.build()


def _add_wall(builder: WorldBuilder, start: float, end: float, y: float, features: tuple, floor: int) -> None:
    """One wall with its doors as holes, then everything that stands out of it or lies behind it."""
    placed, x = [], start
    while True:
        kind, gap, length = features[len(placed) % len(features)]
        if x + gap + length > end - 0.5:
            break
        placed.append((kind, x + gap, x + gap + length))
        x += gap + length
    holes: list[Hole] = [(a - start, 0.0, b - start, _DOOR_HEIGHT_M) for k, a, b in placed if k in ("door", "open")]
    builder.add_patch((start, y, 0.0), (end - start, 0, 0), (0, 0, HEIGHT_M), toward=(0, 0, 1), holes=holes)
    for kind, a, b in placed:
        if kind in ("door", "open"):
            _add_niche(builder, a, b, y, depth=_DOOR_DEPTH_M if kind == "door" else 2.5, floor=floor)
        else:
            _add_block(builder, kind, a, b, y)


def _add_niche(builder: WorldBuilder, a: float, b: float, y: float, *, depth: float, floor: int) -> None:
    """A door set back into the wall, or an open doorway to a narrow closed room."""
    back = y + depth if y > 0 else y - depth
    middle = ((a + b) / 2.0, (y + back) / 2.0, _DOOR_HEIGHT_M / 2.0)
    low = min(y, back)
    builder.add_patch((a, back, 0.0), (b - a, 0, 0), (0, 0, _DOOR_HEIGHT_M), toward=middle)
    for x in (a, b):
        builder.add_patch((x, low, 0.0), (0, depth, 0), (0, 0, _DOOR_HEIGHT_M), toward=middle)
    builder.add_patch((a, low, 0.0), (b - a, 0, 0), (0, depth, 0), toward=middle, plane=floor)
    builder.add_patch((a, low, _DOOR_HEIGHT_M), (b - a, 0, 0), (0, depth, 0), toward=middle)


#: Depth out of the wall, bottom, top, m.
_BLOCKS = {"locker": (0.05, 0.0, 1.9), "closet": (0.40, 0.0, 2.1), "board": (0.02, 1.0, 2.0)}


def _add_block(builder: WorldBuilder, kind: str, a: float, b: float, y: float) -> None:
    """Lockers, a closet or a notice-board: a box against the wall."""
    depth, bottom, top = _BLOCKS[kind]
    front = y - depth if y > 0 else y + depth
    against = "y+" if y > 0 else "y-"
    hidden = [against] if bottom > 0.0 else [against, "z-"]
    builder.add_box((a, min(y, front), bottom), (b, max(y, front), top), hidden=hidden)


def _add_ceiling(builder: WorldBuilder, start: float, end: float) -> None:
    """Neon lamps along the middle, round steel beams from wall to wall, both just under the ceiling."""
    x = start + 1.5
    while x + 1.5 < end:
        builder.add_box((x, -0.12, HEIGHT_M - 0.10), (x + 1.3, 0.12, HEIGHT_M), hidden=["z+"])
        builder.add_bar((x + 2.4, -WIDTH_M / 2.0, HEIGHT_M - 0.25), (x + 2.4, WIDTH_M / 2.0, HEIGHT_M - 0.25), 0.07)
        x += 4.0
