"""The local map of laser odometry: the surfaces that scans along the last metres of the way showed."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from slam.frontend.laser_odometry._scan_kernels import Cells, nearness, surface_of
from slam.frontend.measurement import usable_ranges
from slam.frontend.occupancy.raster import Raster, free_standing
from slam.sensors.log import LaserScan
from slam.sensors.rig import Sensor
from spplanes._check import FloatArray

#: Side of the cells in which the map's points are found, m: as wide as they are looked for.
CELL_M = 0.2
#: Side of the cells of the table that says how near the next surface is, m.
TABLE_CELL_M = 0.1


class Surface(NamedTuple):
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
    def of(cls, scan: LaserScan, sensor: Sensor) -> Surface:
        """From a scan of a level laser."""
        every = max(1, -(-len(scan.ranges) // 400))  # thinned evenly to no more beams
        ranges, angles = usable_ranges(scan.ranges, sensor)[::every], scan.angles[::every]
        seen, mount = np.isfinite(ranges), sensor.body_T_sensor
        directions = np.stack((np.cos(angles[seen]), np.sin(angles[seen])), axis=1) @ mount[:2, :2].T
        away = directions * -ranges[seen][:, None]
        points = mount[:2, 3] - away
        step = float(np.abs(np.diff(angles)).mean()) if len(angles) > 1 else 1.0
        noise = sensor.range_variance_m2, sensor.surface_sigma_m**2, sensor.surface_correlation_m
        normals, variance, looks, turns = surface_of(points, away, step, *noise)
        things = free_standing(-away, step)
        many = np.bincount(things[things >= 0], looks[things >= 0])  # all of a thing that walks is off alike
        looks[things >= 0] /= np.maximum(many, 1.0)[things[things >= 0]]
        kept = np.isfinite(normals[:, 0])
        return cls(points[kept], normals[kept], variance[kept], looks[kept], turns[kept], mount[:2, 3])

    def beams(self, pose: FloatArray) -> FloatArray:
        """Beams from a pose (x, y, theta) of the body, rows (x0, y0, x1, y1), shape (N, 4)."""
        ends = _turned(self.points, pose[2]) + pose[:2]
        return np.hstack((np.broadcast_to(_turned(self.origin, pose[2]) + pose[:2], ends.shape), ends))


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Surfaces of several scans in one frame, ready to be asked what is near a place."""

    scans: tuple[tuple[Surface, FloatArray], ...]
    """The scans and their poses (x, y, theta)."""
    _tables: dict[float, tuple[FloatArray, FloatArray]] = field(default_factory=dict, repr=False)

    def extended(self, surface: Surface, pose: FloatArray) -> LocalMap:
        """With a scan more, and without those farther back along the way than some metres."""
        scans = (*self.scans, (surface, pose))[-40:]  # turns on the spot make no way
        places = np.array([place for _, place in scans])[:, :2]
        way_m = np.cumsum(np.hypot(*np.diff(places, axis=0).T)[::-1])
        return LocalMap(scans[-1 - np.count_nonzero(way_m <= 6.0) :])

    @property
    def is_empty(self) -> bool:
        """Whether nothing was seen."""
        return not any(len(surface.points) for surface, _ in self.scans)

    @cached_property
    def cells(self) -> Cells:
        """The points of all scans, in cells of `CELL_M`."""
        normals = np.concatenate([_turned(surface.normals, pose[2]) for surface, pose in self.scans])
        weights = np.concatenate([1.0 / surface.variance for surface, _ in self.scans])
        places, directions, weight = _patches(self._beams[:, 2:], normals, weights)
        origin = places.min(axis=0) - CELL_M
        columns, rows = (np.ceil((places.max(axis=0) - origin) / CELL_M) + 2).astype(int).tolist()
        column, row = ((places - origin) / CELL_M).astype(np.int64).T
        home = row * columns + column
        order, start = np.argsort(home, kind="stable"), np.zeros(rows * columns + 1, dtype=np.int64)
        np.cumsum(np.bincount(home, minlength=rows * columns), out=start[1:])
        return Cells(places[order], directions[order], weight[order], start, origin, CELL_M, columns, rows)

    @cached_property
    def raster(self) -> Raster:
        """What the scans found occupied and free; half a metre of wall counts as one independent look."""
        return Raster.of(self._beams, 0.5)

    @cached_property
    def _beams(self) -> FloatArray:
        return np.concatenate([surface.beams(pose) for surface, pose in self.scans])

    def table(self, coarser: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """How near every place is to a surface, in cells so many times as wide, and the corner of the first cell."""
        if coarser not in self._tables:
            cell, cells = coarser * TABLE_CELL_M, self.cells
            origin = cells.origin - 3.0 * cell
            columns, rows = np.ceil(np.array((cells.columns, cells.rows)) * CELL_M / cell + 6.0).astype(int).tolist()
            self._tables[coarser] = nearness(cells.points, origin, cell, columns, rows), origin
        return self._tables[coarser]


def _turned(rows: FloatArray, angle: float) -> FloatArray:
    """Rows (..., 2), turned."""
    c, s = np.cos(angle), np.sin(angle)
    return rows @ np.array(((c, s), (-s, c)))


def _patches(points: FloatArray, normals: FloatArray, weights: FloatArray) -> tuple[FloatArray, ...]:
    """Points (N, 2) that lie in one square of 5 cm and look one of 8 ways made one: means, and their weight."""
    squares = np.floor((points - points.min(axis=0)) / 0.05).astype(np.int64)
    ways = np.floor(np.arctan2(normals[:, 1], normals[:, 0]) * (8 / (2.0 * np.pi))).astype(np.int64) + 8
    keys = (squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1]) * 16 + ways
    _, patch = np.unique(keys, return_inverse=True)
    total = np.asarray(np.bincount(patch, weights), dtype=np.float64)
    places, directions = (
        np.stack([np.bincount(patch, weights * rows[:, axis]) for axis in (0, 1)], axis=1) for rows in (points, normals)
    )
    lengths = np.sqrt(directions[:, 0] ** 2 + directions[:, 1] ** 2)
    return places / total[:, None], directions / np.maximum(lengths, 1e-12)[:, None], total
