"""Two single spaces: a room with slanted corners for 2D lines, a hall with pillars and a pitched roof for 3D scans."""

from __future__ import annotations

import numpy as np

from slam.simulation.path import Path
from slam.simulation.world import World, WorldBuilder

#: The room: length, width, height, and how much of two of its corners is cut off, m.
ROOM_M, CUT_M = (8.0, 6.0, 2.6), 1.5
#: The hall: length, width, height of its long walls and of its ridge, m.
HALL_M, RIDGE_M = (30.0, 20.0, 6.0), 8.0


def room() -> World:
    """A closed room around the origin: eight walls, two of them slanted, a cupboard, a table leg, a round pillar."""
    builder = WorldBuilder()
    x, y, height = ROOM_M[0] / 2.0, ROOM_M[1] / 2.0, ROOM_M[2]
    middle, up = (0.0, 0.0, height / 2.0), (0.0, 0.0, height)
    outline = [(-x, -y), (x - CUT_M, -y), (x, -y + CUT_M), (x, y), (-x + CUT_M, y), (-x, y - CUT_M)]
    for a, b in zip(outline, [*outline[1:], outline[0]], strict=True):
        builder.add_patch((*a, 0.0), (b[0] - a[0], b[1] - a[1], 0.0), up, toward=middle)
    for z in (0.0, height):
        builder.add_patch((-x, -y, z), (2.0 * x, 0, 0), (0, 2.0 * y, 0), toward=middle)
    builder.add_box((-x, 0.2, 0.0), (-x + 0.5, 1.4, 1.9), hidden=["x-", "z-"])
    builder.add_box((2.2, 1.6, 0.0), (2.6, 2.0, 1.2), hidden=["z-"])
    builder.add_bar((-1.8, -2.0, 0.0), (-1.8, -2.0, height), 0.2)
    return builder.build()


def room_path(laps: int) -> Path:
    """A rounded rectangle about the middle of the room, from the origin."""
    corners = [(1.5, 0.0), (1.5, 1.2), (-1.8, 1.2), (-1.8, 0.0)]
    return Path.rounded([(0.0, 0.0), *(corners * laps), (0.5, 0.0)], 0.5)


def hall() -> World:
    """A closed hall: long walls, gables, a roof of two slopes, two rows of square pillars, crates and round columns."""
    builder = WorldBuilder()
    x, y, height = HALL_M[0] / 2.0, HALL_M[1] / 2.0, HALL_M[2]
    middle = (0.0, 0.0, height / 2.0)
    builder.add_patch((-x, -y, 0.0), (2.0 * x, 0, 0), (0, 2.0 * y, 0), toward=middle)
    for side in (-1.0, 1.0):
        builder.add_patch((-x, side * y, 0.0), (2.0 * x, 0, 0), (0, 0, height), toward=middle)
        builder.add_patch((-x, side * y, height), (2.0 * x, 0, 0), (0, -side * y, RIDGE_M - height), toward=middle)
        builder.add_patch((side * x, -y, 0.0), (0, 2.0 * y, 0), (0, 0, RIDGE_M), toward=middle)
    for place in np.linspace(-10.0, 10.0, 5):
        for side in (-5.0, 5.0):
            builder.add_box((place - 0.3, side - 0.3, 0.0), (place + 0.3, side + 0.3, RIDGE_M), hidden=["z-", "z+"])
    for k, (a, b) in enumerate([(-12.0, -8.0), (-3.0, 8.0), (4.0, -8.5), (12.0, 7.0)]):
        builder.add_box((a, b, 0.0), (a + 1.5 + 0.3 * k, b + 1.2, 1.0 + 0.3 * k), hidden=["z-"])
        builder.add_bar((a - 1.0, b, 0.0), (a - 1.0, b, RIDGE_M), 0.25)
    return builder.build()


def hall_path(laps: int) -> Path:
    """A rounded rectangle between the rows of pillars and the walls, from the origin's side of it."""
    corners = [(11.5, 0.0), (11.5, 6.5), (-12.0, 6.5), (-12.0, 0.0)]
    return Path.rounded([(0.0, 0.0), *(corners * laps), (1.0, 0.0)], 1.5)
