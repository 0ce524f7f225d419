"""Kinds of buildings, each a function of a generator: irregular, sloped, cluttered, glass, bare, symmetric, a ramp."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from shapely import LineString, Polygon, box, unary_union

from benchmarks.corpus.drives.building import Panes, Roof, add_furniture, add_shell, tidy
from benchmarks.corpus.drives.scene import Course, Scene, Walker
from benchmarks.corpus.polygon_world import PolygonBuilder
from slam.simulation.robots import Path
from spplanes._check import FloatArray

#: Radius the robot takes its corners with, m.
_TURN_M = 0.6
#: Widths of a door and of what is behind its frame, m.
_DOOR_M, _FRAME_M = 0.95, 0.15
#: Clear height of every corridor of a building with a ramp, and length of its landings, m.
_HIGH_M, _LANDING_M = 2.5, 2.4


def irregular(rng: np.random.Generator) -> Scene:
    """A corridor that bends without right angles, rooms of four unequal corners on it, some furniture."""
    corners = _bends(rng, skewed=True)
    plan = _with_rooms(_corridor(corners, rng), corners, rng, skewed=True)
    return _furnished(plan, corners, Roof.flat(rng.uniform(2.4, 3.2)), rng, pieces=8, oblique=True)


def office(rng: np.random.Generator) -> Scene:
    """The same at right angles, which most buildings are."""
    corners = _bends(rng, skewed=False)
    plan = _with_rooms(_corridor(corners, rng), corners, rng, skewed=False)
    return _furnished(plan, corners, Roof.flat(rng.uniform(2.4, 3.2)), rng, pieces=8, oblique=False)


def loop(rng: np.random.Generator) -> Scene:
    """A corridor round a block without right angles, a lap and a third."""
    angles = np.cumsum(rng.dirichlet(np.full(5, 30.0))) * 2.0 * np.pi
    ring = rng.uniform(5.0, 7.5, 5)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    whole = np.vstack([ring, ring[:1]])
    plan = _with_rooms(_corridor(whole, rng), whole, rng, skewed=True)
    start = ring[0] + 0.4 * (ring[1] - ring[0])
    corners = np.vstack([start, ring[1:], ring[:2], ring[1] + 0.5 * (ring[2] - ring[1])])
    return _furnished(plan, corners, Roof.flat(rng.uniform(2.4, 3.2)), rng, pieces=8, oblique=True)


def sloped(rng: np.random.Generator) -> Scene:
    """An irregular building under a roof of one slope, or of two."""
    corners = _bends(rng, skewed=True)
    plan = _with_rooms(_corridor(corners, rng), corners, rng, skewed=True)
    middle, turn = np.array(plan.centroid.coords[0]), rng.uniform(0.0, 2.0 * np.pi)
    slope = np.tan(rng.uniform(0.03, 0.15)) * np.array([np.cos(turn), np.sin(turn)])
    ridge = 2.6 + float(np.abs((np.array(plan.exterior.coords) - middle) @ slope).max())
    planes = [(ridge - middle @ slope, *slope)]
    if rng.random() < 0.5:
        planes.append((ridge + middle @ slope, *-slope))
    return _furnished(plan, corners, Roof(np.array(planes)), rng, pieces=8, oblique=True)


def cluttered(rng: np.random.Generator) -> Scene:
    """A hall without right angles full of boxes and poles at all angles."""
    ring, corners = _hall(rng)
    return _furnished(Polygon(ring), corners, Roof.flat(rng.uniform(3.0, 5.0)), rng, pieces=45, oblique=True, poles=12)


def hall(rng: np.random.Generator) -> Scene:
    """The same hall, nearly empty."""
    ring, corners = _hall(rng)
    return _furnished(Polygon(ring), corners, Roof.flat(rng.uniform(3.0, 5.0)), rng, pieces=6, oblique=True)


def glass(rng: np.random.Generator) -> Scene:
    """An irregular building in which a third of the longer walls are mostly glass: beams do not come back."""
    corners = _bends(rng, skewed=True)
    plan, panes = tidy(_with_rooms(_corridor(corners, rng), corners, rng, skewed=True)), {}
    for r, ring in enumerate((plan.exterior, *plan.interiors)):
        for e, (a, b) in enumerate(pairwise(np.array(ring.coords))):
            if np.linalg.norm(b - a) > 1.5 and rng.random() < 0.35:
                panes[r, e] = (float(rng.uniform(0.1, 0.3)), float(rng.uniform(0.7, 0.9)))
    return _furnished(plan, corners, Roof.flat(rng.uniform(2.4, 3.2)), rng, pieces=6, oblique=True, glass=panes)


def bare(rng: np.random.Generator) -> Scene:
    """A straight corridor of 160 m without a door; nothing along it tells where one is."""
    half, builder = rng.uniform(0.9, 1.4), PolygonBuilder()
    add_shell(builder, box(-80.0, -half, 80.0, half), Roof.flat(rng.uniform(2.4, 3.0)))
    return Scene(builder.build(), Course(Path.weaving(20.0)))


def symmetric(rng: np.random.Generator) -> Scene:
    """A square ring of corridors whose sides, doors and rooms are all alike, a lap and a third."""
    side, half, deep = rng.uniform(8.0, 10.0), rng.uniform(1.0, 1.3), rng.uniform(2.5, 3.5)
    far = side / 2.0
    block = box(half - far, half - far, far - half, far - half)
    ring, quarter = box(-far - half, -far - half, far + half, far + half).difference(block), []
    for at in (-0.25 * side, 0.25 * side):
        quarter.append(box(at - _DOOR_M / 2, -far - half - _FRAME_M - 0.1, at + _DOOR_M / 2, -far - half + 0.1))
        quarter.append(box(at - 1.5, -far - half - _FRAME_M - deep, at + 1.5, -far - half - _FRAME_M))
    turned = [Polygon(np.array(p.exterior.coords) @ _turn(k)) for k in range(4) for p in quarter]
    signs = [(-0.3, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0), (1.0, 0.0)]
    corners, plan = far * np.array(signs), unary_union([ring, *turned])
    assert isinstance(plan, Polygon)
    return _furnished(plan, corners, Roof.flat(2.6), rng, pieces=0, oblique=False)


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


def people(rng: np.random.Generator) -> Scene:
    """An irregular building in which six people walk up and down the corridor."""
    quiet = irregular(rng)
    length, speeds = quiet.course.length_m, rng.uniform(0.5, 1.5, 6) * rng.choice([-1.0, 1.0], 6)
    starts, sides = rng.uniform(0.0, length, 6), rng.uniform(-0.7, 0.7, 6)
    walkers = [Walker(float(a), float(v), float(b)) for a, v, b in zip(starts, speeds, sides, strict=True)]
    return Scene(quiet.world, quiet.course, tuple(walkers))


#: Kinds of world.
WORLDS: dict[str, Callable[[np.random.Generator], Scene]] = {
    build.__name__: build
    for build in (irregular, office, loop, sloped, cluttered, hall, glass, bare, symmetric, ramp, people)
}


def _turn(quarters: int) -> FloatArray:
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters]
    return np.array([[c, s], [-s, c]], dtype=np.float64)


def _bends(rng: np.random.Generator, *, skewed: bool) -> FloatArray:
    """Corners (5, 2) of a way of some 22 m that does not come near itself."""
    while True:
        lengths = rng.uniform(4.0, 7.0, 4)
        turns = rng.choice([-1.0, 1.0], 3) * (rng.uniform(0.35, 1.2, 3) if skewed else np.pi / 2.0)
        headings = np.cumsum([rng.uniform(-0.5, 0.5) if skewed else 0.0, *turns])
        steps = lengths[:, None] * np.column_stack([np.cos(headings), np.sin(headings)])
        corners = np.vstack([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        room = LineString(corners).buffer(2.0)
        if isinstance(room, Polygon) and not room.interiors:
            return corners


def _corridor(corners: FloatArray, rng: np.random.Generator) -> Polygon:
    """The corridor along a way, every stretch of its own width."""
    stretches = [LineString([a, b]).buffer(rng.uniform(0.9, 1.4), cap_style="square") for a, b in pairwise(corners)]
    union = unary_union(stretches)
    assert isinstance(union, Polygon)
    return union


def _with_rooms(plan: Polygon, corners: FloatArray, rng: np.random.Generator, *, skewed: bool) -> Polygon:
    """The corridor with rooms behind doors, on both sides of every stretch where there is space for one."""
    taken, pieces = plan, [plan]
    for a, b in pairwise(corners):
        along = (b - a) / np.linalg.norm(b - a)
        for side in (1.0, -1.0):
            place = a + rng.uniform(0.35, 0.65) * (b - a)
            room, door = _room(place, along, side * np.array([-along[1], along[0]]), rng, skewed=skewed)
            if not room.buffer(0.1).intersects(taken):
                taken = taken.union(room)
                pieces += [room, door]
    union = unary_union(pieces)
    assert isinstance(union, Polygon)
    return union


def _room(
    place: FloatArray, along: FloatArray, out: FloatArray, rng: np.random.Generator, *, skewed: bool
) -> tuple[Polygon, Polygon]:
    """A room of four corners beyond the wall of a corridor, and its doorway."""
    near, deep = 1.4 + _FRAME_M + 0.05, rng.uniform(2.5, 4.0)
    lefts, rights = rng.uniform(1.0, 2.0, 2), rng.uniform(1.0, 2.0, 2)
    lean = rng.uniform(0.0, 0.4, 2) if skewed else np.zeros(2)
    if not skewed:
        lefts[1], rights[1] = lefts[0], rights[0]
    local = [(-lefts[0], near + lean[0]), (rights[0], near)]
    local += [(rights[1], near + deep + lean[1]), (-lefts[1], near + deep)]
    half = _DOOR_M / 2.0
    door = [(-half, 0.0), (half, 0.0), (half, near + 0.4), (-half, near + 0.4)]
    room, doorway = (Polygon([place + s * along + n * out for s, n in ring]) for ring in (local, door))
    return room, doorway


def _hall(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Corners of a hall of six unequal sides, and of a way round in it."""
    angles = (np.arange(6) + rng.uniform(-0.25, 0.25, 6)) * np.pi / 3.0
    ring = rng.uniform(8.0, 11.0, 6)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    way = 0.5 * ring
    return ring, np.vstack([0.5 * (way[0] + way[1]), way[1:], way[0], 0.2 * way[0] + 0.8 * way[1]])


def _furnished(
    plan: Polygon,
    corners: FloatArray,
    roof: Roof,
    rng: np.random.Generator,
    *,
    pieces: int,
    oblique: bool,
    poles: int = 0,
    glass: Panes | None = None,
) -> Scene:
    """The building with furniture, and the way through it."""
    builder, points = PolygonBuilder(), [(float(x), float(y)) for x, y in corners]
    add_shell(builder, plan, roof, glass=glass)
    add_furniture(builder, plan, LineString(points), rng, pieces=pieces, oblique=oblique, poles=poles)
    return Scene(builder.build(), Course(Path.rounded(points, _TURN_M)))


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
