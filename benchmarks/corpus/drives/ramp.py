"""Two floors, one over the other, with a ramp between them."""

import numpy as np

from benchmarks.corpus.drives.scene import Course, Scene
from benchmarks.corpus.polygon_world import PolygonBuilder
from slam.simulation.robots import Path

#: Clear height of every corridor, and length of the landings, m.
_HIGH_M, _LANDING_M = 2.5, 2.4


def ramp(rng: np.random.Generator) -> Scene:
    """A corridor, a landing, a ramp back beside it, a landing, and a corridor over the first one."""
    half, apart = rng.uniform(0.9, 1.1), rng.uniform(3.0, 3.6)
    length, climb = rng.uniform(12.0, 14.0), rng.uniform(2.9, 3.2)
    builder = PolygonBuilder()
    _add_tube(builder, 0.0, half, (0.0, length), (0.0, 0.0))
    _add_tube(builder, apart, half, (0.0, length), (climb, 0.0))
    _add_tube(builder, 0.0, half, (0.0, length), (climb, climb))
    _add_end(builder, 0.0, half, 0.0, -1.0)
    _add_end(builder, length, half, climb, 1.0)
    _add_landing(builder, half, apart, (length, length + _LANDING_M), 0.0)
    _add_landing(builder, half, apart, (0.0, -_LANDING_M), climb)
    middle = _LANDING_M / 2.0
    corners = [(1.0, 0.0), (length + middle, 0.0), (length + middle, apart), (-middle, apart), (-middle, 0.0)]
    path = Path.rounded([*corners, (length - 2.0, 0.0)], 0.7)
    on_ramp = np.clip((length - path.poses[:, 0]) / length, 0.0, 1.0) * climb
    back = int(np.argmin(np.abs(path.poses[:, 0] + middle) + np.abs(path.poses[:, 1] - apart / 2.0)))
    heights = np.where(path.poses[:, 1] > apart / 2.0, on_ramp, 0.0)
    heights[back:] = climb
    return Scene(builder.build(), Course(path, heights))


def _add_tube(builder: PolygonBuilder, y: float, half: float, x: tuple[float, float], z: tuple[float, float]) -> None:
    """A straight corridor between two places, its floor from one height to another."""
    mid = (sum(x) / 2.0, y, sum(z) / 2.0 + 1.2)
    for lift in (0.0, _HIGH_M):
        sides = ((0, -half), (1, -half), (1, half), (0, half))
        builder.add_polygon([[(x[k], y + side, z[k] + lift) for k, side in sides]], toward=mid)
    for side in (-half, half):
        ends = ((0, 0.0), (1, 0.0), (1, _HIGH_M), (0, _HIGH_M))
        builder.add_polygon([[(x[k], y + side, z[k] + lift) for k, lift in ends]], toward=mid)


def _add_end(builder: PolygonBuilder, x: float, half: float, z: float, way: float) -> None:
    """The closed end of a corridor, which runs toward it along `way`."""
    ring = [(x, -half, z), (x, half, z), (x, half, z + _HIGH_M), (x, -half, z + _HIGH_M)]
    builder.add_polygon([ring], toward=(x - way, 0.0, z + 1.0))


def _add_landing(builder: PolygonBuilder, half: float, apart: float, x: tuple[float, float], z: float) -> None:
    """A room into which two corridors lead at `x[0]`: three walls, and the pier between the corridors."""
    low, high, top = -half, apart + half, z + _HIGH_M
    mid = (sum(x) / 2.0, apart / 2.0, z + 1.2)
    for level in (z, top):
        ring = [(x[0], low, level), (x[1], low, level), (x[1], high, level), (x[0], high, level)]
        builder.add_polygon([ring], toward=mid)
    for y in (low, high):
        builder.add_polygon([[(x[0], y, z), (x[1], y, z), (x[1], y, top), (x[0], y, top)]], toward=mid)
    builder.add_polygon([[(x[1], low, z), (x[1], high, z), (x[1], high, top), (x[1], low, top)]], toward=mid)
    pier = [(x[0], half, z), (x[0], apart - half, z), (x[0], apart - half, top), (x[0], half, top)]
    builder.add_polygon([pier], toward=mid)
