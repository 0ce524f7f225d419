"""Floor plans for one level laser: corridors around a block, or walls of one's own, driven with bad wheels."""

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from slam.geometry.frames import inverse, planar_transform
from slam.sensors.log import Event, LaserScan, Log, OdometryReading
from spplanes._check import FloatArray

#: Time between scans, ns.
PERIOD_NS = 100_000_000
#: Depth and width of door recesses, m.
RECESS_M, WIDTH_M = 0.12, 0.9
#: Length over which a wall deviates from straight by one value, m.
PATCH_M = 0.5


@dataclass(frozen=True)
class Wheels:
    """What the odometry does wrong."""

    scale: float = 0.03  # share by which ways are read too long
    curvature_rad_per_m: float = 0.03  # turn that is not read, per metre
    noise_rad_per_sqrt_m: float = 0.015  # random turn after a metre
    noise_per_turn: float = 0.03  # random turn after turning by a radian
    slip_rad: float = 0.1  # turn that is not read at each of the slips
    slip_m: float = 0.2  # way that is read and not driven at each of the slips
    n_slips: int = 2  # on the whole way


@dataclass(frozen=True, eq=False)
class Drive:
    """A simulated log with its truth."""

    log: Log  # odometry and scans of sensor FLASER, ten centimetres apart
    poses: FloatArray  # true world_T_body at every scan, shape (N, 4, 4), the first at the origin of the log
    walls: FloatArray  # their ends in the same world, shape (W, 2, 2), free space on the left from first to second

    def poses_at(self, stamps_ns: np.ndarray) -> FloatArray:
        """True poses relative to the first one, at times of scans, shape (N, 4, 4)."""
        return self.poses[np.asarray(stamps_ns) // PERIOD_NS]


@dataclass
class FloorPlan:
    """Walls, and a way between them."""

    walls: list[tuple[tuple[float, float], tuple[float, float]]] = field(default_factory=list)  # ends of each, m
    way: list[tuple[float, float]] = field(default_factory=list)  # corners of it, m

    def add_chain(self, corners: list[tuple[float, float]]) -> None:
        """A wall around corners, free space on its left."""
        self.walls += list(pairwise(corners))

    def add_wall(self, start: tuple[float, float], end: tuple[float, float], doors: list[float]) -> None:
        """A straight wall with recessed doors that begin at distances along it; free space on its left."""
        a, b = np.array(start), np.array(end)
        along = (b - a) / np.linalg.norm(b - a)
        back, corners = np.array((along[1], -along[0])) * RECESS_M, [a]
        for door in doors:
            near, far = a + door * along, a + (door + WIDTH_M) * along
            corners += [near, near + back, far + back, far]
        self.add_chain([(float(x), float(y)) for x, y in [*corners, b]])

    def add_box(self, x: float, y: float, width: float, depth: float) -> None:
        """Something that stands about."""
        self.add_chain([(x, y), (x, y + depth), (x + width, y + depth), (x + width, y), (x, y)])


def ring(rng: np.random.Generator, *, length_m: float, depth_m: float, doors_per_wall: int) -> FloorPlan:
    """Corridors around a block, once round and 7 m further; doors at random places."""
    plan, half = FloorPlan(), rng.uniform(0.9, 1.3)
    corners = np.array(((0.0, 0.0), (length_m, 0.0), (length_m, depth_m), (0.0, depth_m)))
    signs = np.array(((-1, -1), (1, -1), (1, 1), (-1, 1)))
    outer, inner = corners + half * signs, corners - half * signs
    for k in range(4):
        for a, b in ((outer[k], outer[(k + 1) % 4]), (inner[(k + 1) % 4], inner[k])):
            plan.add_wall(tuple(a), tuple(b), _places(rng, float(np.linalg.norm(b - a)), doors_per_wall))
    start = np.array((0.35 * length_m, 0.0))
    way = [start, *corners[1:], corners[0], start + np.array((7.0, 0.0))]
    plan.way = [(float(x), float(y)) for x, y in way]
    return plan


def drive(
    plan: FloorPlan,
    rng: np.random.Generator,
    *,
    n_beams: int = 181,
    range_max_m: float = 8.0,
    wheels: Wheels = Wheels(),
) -> Drive:
    """Drive the way, turning on the spot at its corners, a scan of half a turn ahead every 10 cm or 0.1 rad.

    Ranges err by 1 cm and are read in whole centimetres; patches of walls are 5 mm off straight (standard deviations).
    """
    true, walls = _poses_along(np.array(plan.way)), np.array(plan.walls)
    angles = np.linspace(-np.pi / 2, np.pi / 2, n_beams)
    bumps = rng.normal(0.0, 0.005, (len(walls), 256))
    slips = set(rng.integers(len(true) // 5, 4 * len(true) // 5, wheels.n_slips).tolist())
    events: list[Event] = []
    odometry = planar_transform(0.0, 0.0, 0.0)
    for index, pose in enumerate(true):
        stamp = index * PERIOD_NS
        if index:
            odometry = odometry @ _misread(true[index - 1], pose, wheels, index in slips, rng)
        ranges = cast(walls, bumps, pose, angles) + rng.normal(0.0, 0.01, angles.size)
        ranges = np.where(ranges < range_max_m, np.round(ranges, 2), np.nan)
        events += [OdometryReading(stamp, odometry), LaserScan(stamp, "FLASER", ranges, angles)]
    to_log = inverse(planar_transform(*true[0]))
    poses = np.array([to_log @ planar_transform(*pose) for pose in true])
    return Drive(Log(events, Path("simulated")), poses, walls @ to_log[:2, :2].T + to_log[:2, 3])


def _places(rng: np.random.Generator, length: float, count: int) -> list[float]:
    """Random distances along a wall, apart from one another and from the ends."""
    share = (length - 1.0) / max(count, 1)
    return [0.5 + share * k + rng.uniform(0.1, max(share - 1.1, 0.2)) for k in range(count)]


def _poses_along(corners: FloatArray) -> FloatArray:
    """(x, y, theta) along a way, shape (N, 3)."""
    rows: list[tuple[float, float, float]] = []
    heading = None
    for a, b in pairwise(corners):
        step = b - a
        direction = float(np.arctan2(step[1], step[0]))
        if heading is not None:
            turn = float(np.remainder(direction - heading + np.pi, 2.0 * np.pi) - np.pi)
            n = int(np.ceil(abs(turn) / 0.1))
            rows += [(a[0], a[1], heading + turn * k / n) for k in range(1, n + 1)]
        heading, length = direction, float(np.linalg.norm(step))
        rows += [(*(a + step * s / length), heading) for s in np.arange(0.0, length, 0.1)[1:]]
    return np.array(rows)


def _misread(last: FloatArray, pose: FloatArray, wheels: Wheels, slips: bool, rng: np.random.Generator) -> FloatArray:
    """The step between two poses (x, y, theta) as the wheels read it, shape (4, 4)."""
    step = inverse(planar_transform(*last)) @ planar_transform(*pose)
    way, turn = float(step[0, 3]), float(np.arctan2(step[1, 0], step[0, 0]))
    noise = wheels.noise_rad_per_sqrt_m * np.sqrt(abs(way)), wheels.noise_per_turn * np.sqrt(abs(turn))
    turn_read = turn - wheels.curvature_rad_per_m * abs(way) + rng.normal(0.0, np.hypot(*noise))
    way_read = way * (1.0 + wheels.scale)
    if slips:
        turn_read -= wheels.slip_rad
        way_read += wheels.slip_m
    return planar_transform(way_read, float(step[1, 3]), turn_read)


def cast(walls: FloatArray, bumps: FloatArray, pose: FloatArray, angles: FloatArray) -> FloatArray:
    """Ranges (B,) from a pose (x, y, theta) to uneven walls; infinity for no wall."""
    directions = angles + pose[2]
    rays = np.stack((np.cos(directions), np.sin(directions)))
    start, along = walls[:, 0] - pose[:2], walls[:, 1] - walls[:, 0]
    cross = along[:, 1, None] * rays[0] - along[:, 0, None] * rays[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0])[:, None] / cross
        share = (rays[1] * start[:, 0, None] - rays[0] * start[:, 1, None]) / cross
    reach[~((reach > 0.0) & (share >= 0.0) & (share <= 1.0))] = np.inf
    nearest, beams = reach.argmin(axis=0), np.arange(angles.size)
    lengths = np.linalg.norm(along, axis=1)
    place = np.where(np.isfinite(reach[nearest, beams]), share[nearest, beams], 0.0) * lengths[nearest] / PATCH_M
    patch = np.clip(place, 0, bumps.shape[1] - 1).astype(int)
    grazing = np.abs(cross[nearest, beams]) / lengths[nearest]
    return reach[nearest, beams] + bumps[nearest, patch] / np.maximum(grazing, 0.1)
