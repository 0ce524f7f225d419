"""The local map of laser odometry: the surfaces that scans along the last metres of the way showed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from slam.frontend.laser_odometry._scan_kernels import Cells, nearness, surface_of
from slam.frontend.occupancy.raster import Raster, free_standing
from slam.sensors.log import LaserScan
from slam.sensors.rig import Sensor
from spplanes._check import FloatArray

#: Side of the cells in which the map's points are found, m: as wide as they are looked for.
CELL_M = 0.2
#: Points that look one way in squares of this side are one, m.
PATCH_M = 0.05
#: Ways that they look.
_WAYS = 8
#: Side of the cells of the table that says how near the next surface is, and the width of its bell, m.
TABLE_CELL_M, TABLE_SIGMA_M = 0.1, 0.1
#: Length of wall whose returns count as one independent look, m.
LOOK_M = 0.5


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that one scan shows, in the frame of the body."""

    points: FloatArray
    """Returns with a normal, shape (N, 2), m."""
    normals: FloatArray
    """Unit normals toward the sensor, shape (N, 2)."""
    variance: FloatArray
    """Of a return along its normal, shape (N,), m^2."""
    looks: FloatArray
    """Share of an independent look at the surface that each return is, shape (N,); a thing that stands free is one."""
    turns: FloatArray
    """Square of the sine by which each normal is expected to err, shape (N,)."""
    origin: FloatArray
    """Where the sensor is, shape (2,), m."""

    @classmethod
    def of(cls, scan: LaserScan, ranges: FloatArray, sensor: Sensor, body_T_sensor: FloatArray) -> Surface:
        """From a scan with its usable ranges (B,), NaN = no return, of a level laser."""
        every = max(1, -(-len(ranges) // 400))  # thinned evenly to no more beams
        ranges, angles = ranges[::every], scan.angles[::every]
        seen = np.isfinite(ranges)
        directions = np.stack((np.cos(angles[seen]), np.sin(angles[seen])), axis=1) @ body_T_sensor[:2, :2].T
        away = directions * -ranges[seen][:, None]
        points = body_T_sensor[:2, 3] - away
        step = float(np.abs(np.diff(angles)).mean()) if len(angles) > 1 else 1.0
        noise = sensor.range_variance_m2, sensor.surface_sigma_m**2, sensor.surface_correlation_m
        normals, variance, looks, turns = surface_of(points, away, step, *noise)
        things = free_standing(-away, step)
        many = np.bincount(things[things >= 0], looks[things >= 0])  # all of a thing that walks is off alike
        looks[things >= 0] /= np.maximum(many, 1.0)[things[things >= 0]]
        kept = np.isfinite(normals[:, 0])
        return cls(points[kept], normals[kept], variance[kept], looks[kept], turns[kept], body_T_sensor[:2, 3])

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def raster(self) -> Raster:
        """What the scan found occupied and free."""
        return Raster.of(self.beams(np.zeros(3)), LOOK_M)

    def beams(self, pose: FloatArray) -> FloatArray:
        """Beams from a pose (x, y, theta) of the body, rows (x0, y0, x1, y1), shape (N, 4)."""
        c, s = np.cos(pose[2]), np.sin(pose[2])
        turn = np.array(((c, s), (-s, c)))
        ends = self.points @ turn + pose[:2]
        return np.hstack((np.broadcast_to(self.origin @ turn + pose[:2], ends.shape), ends))


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Surfaces of several scans, in one frame, ready to be asked what is near a place."""

    cells: Cells
    """Their points, in cells of `CELL_M`."""
    _seen: tuple[tuple[Surface, FloatArray], ...]
    """The scans and their poses."""
    _tables: dict[float, tuple[FloatArray, FloatArray]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, surfaces: list[Surface], poses: list[FloatArray]) -> LocalMap:
        """Of surfaces at poses (x, y, theta)."""
        points, normals, weights = [], [], []
        for surface, (x, y, theta) in zip(surfaces, poses, strict=True):
            c, s = np.cos(theta), np.sin(theta)
            turn = np.array(((c, s), (-s, c)))
            points.append(surface.points @ turn + (x, y))
            normals.append(surface.normals @ turn)
            weights.append(1.0 / surface.variance)
        places, directions, weight = _patches(np.concatenate(points), np.concatenate(normals), np.concatenate(weights))
        origin = places.min(axis=0) - CELL_M
        columns, rows = (np.ceil((places.max(axis=0) - origin) / CELL_M) + 2).astype(int).tolist()
        column, row = ((places - origin) / CELL_M).astype(np.int64).T
        home = row * columns + column
        order, start = np.argsort(home, kind="stable"), np.zeros(rows * columns + 1, dtype=np.int64)
        np.cumsum(np.bincount(home, minlength=rows * columns), out=start[1:])
        cells = Cells(places[order], directions[order], weight[order], start, origin, CELL_M, columns, rows)
        return cls(cells, tuple(zip(surfaces, poses, strict=True)))

    @cached_property
    def raster(self) -> Raster:
        """What the scans found occupied and free."""
        return Raster.of(np.concatenate([surface.beams(pose) for surface, pose in self._seen]), LOOK_M)

    def table(self, coarser: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """How near every place is to a surface, in cells so many times as wide, and the corner of the first cell."""
        if coarser not in self._tables:
            cell, cells = coarser * TABLE_CELL_M, self.cells
            origin = cells.origin - 3.0 * cell
            columns, rows = np.ceil(np.array((cells.columns, cells.rows)) * CELL_M / cell + 6.0).astype(int).tolist()
            table = nearness(cells.points, origin, cell, columns, rows, coarser * TABLE_SIGMA_M)
            self._tables[coarser] = table, origin
        return self._tables[coarser]


def _patches(points: FloatArray, normals: FloatArray, weights: FloatArray) -> tuple[FloatArray, ...]:
    """Points (N, 2) that lie in one small square and look the same way made one: means, and their weight."""
    squares = np.floor((points - points.min(axis=0)) / PATCH_M).astype(np.int64)
    ways = np.floor(np.arctan2(normals[:, 1], normals[:, 0]) * (_WAYS / (2.0 * np.pi))).astype(np.int64) + _WAYS
    keys = (squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1]) * 2 * _WAYS + ways
    _, patch = np.unique(keys, return_inverse=True)
    total = np.asarray(np.bincount(patch, weights), dtype=np.float64)
    places, directions = (
        np.stack([np.bincount(patch, weights * rows[:, axis]) for axis in (0, 1)], axis=1) for rows in (points, normals)
    )
    lengths = np.sqrt(directions[:, 0] ** 2 + directions[:, 1] ** 2)
    return places / total[:, None], directions / np.maximum(lengths, 1e-12)[:, None], total


class SlidingMap:
    """The scans along the last metres of the way, and the map of them; made anew when one is added."""

    def __init__(self) -> None:
        self._surfaces: list[Surface] = []
        self._poses: list[FloatArray] = []
        self._map: LocalMap | None = None

    def add(self, surface: Surface, pose: FloatArray) -> None:
        """Add a scan at a pose (x, y, theta), and forget those the window has left."""
        self._surfaces.append(surface)
        self._poses.append(pose)
        way, first = 0.0, len(self._poses) - 1
        while first > 0 and len(self._poses) - first < 40:  # turns on the spot make no way
            way += float(np.hypot(*(self._poses[first] - self._poses[first - 1])[:2]))
            if way > 6.0:  # m
                break
            first -= 1
        del self._surfaces[:first], self._poses[:first]
        self._map = None

    @property
    def last_pose(self) -> FloatArray | None:
        """Where the last scan was added."""
        return self._poses[-1] if self._poses else None

    @property
    def map(self) -> LocalMap | None:
        """The map; None where nothing was seen."""
        if self._map is None and sum(map(len, self._surfaces)):
            self._map = LocalMap.of(self._surfaces, self._poses)
        return self._map
