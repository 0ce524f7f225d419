"""What the laser saw around a place: a raster of occupied, free and unknown cells, to compare views, and what may move.

Small things in front of all beside them stand free, and may be on their way, as people are.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from slam.frontend.occupancy._kernels import mark, squared_distances
from slam.sensors.log import LaserScan
from spplanes._check import FloatArray

#: Side of a cell, m.
CELL_M = 0.05
#: Standard deviation of a return from where the raster has its surface, m: noise, the cell and the wall's unevenness.
SIGMA_M = 0.05
#: Share of returns that come from what was not there, or not seen, when the other view was taken.
NOVEL_SHARE = 0.1
_REACH = 3
#: Cosine of the largest lean of a laser whose scans are compared across poses: 3 deg.
LEVEL_COSINE = float(np.cos(np.radians(3.0)))
#: Neighbouring returns further apart than so many steps of the beams at their range, and m, are of two surfaces.
GAP_STEPS, LEAST_GAP_M = 6.0, 0.15
#: What is narrower and stands free may move, m.
MOVABLE_M = 1.0


class Raster(NamedTuple):
    """Beams of one view, rasterised: for each cell the log ratio of a return's density there to that in the unknown."""

    origin: FloatArray
    """Corner of the first cell, shape (2,), m."""
    table: FloatArray
    """Log ratios, shape (H, W): positive on what is occupied, negative in what is free, 0 in what was not seen."""
    points: FloatArray
    """Returns, one in every square of some side, shape (N, 2), m."""
    weight: float
    """Independent looks that a point is."""

    @classmethod
    def of(cls, beams: FloatArray, look_m: float) -> Raster:
        """From beams (N, 4) as rows (x0, y0, x1, y1); a length `look_m` of wall counts as one independent look."""
        low = np.minimum(beams[:, :2], beams[:, 2:]).min(axis=0) - _REACH * CELL_M
        high = np.maximum(beams[:, :2], beams[:, 2:]).max(axis=0) + _REACH * CELL_M
        columns, rows = np.ceil((high - low) / CELL_M).astype(int) + 1
        hits, passes = np.zeros((rows, columns), dtype=np.int32), np.zeros((rows, columns), dtype=np.int32)
        mark(beams, low, CELL_M, 3.0 * SIGMA_M, hits, passes)
        squared = squared_distances(hits, _REACH)
        mean_range = float(np.linalg.norm(beams[:, 2:] - beams[:, :2], axis=1).mean())
        points, spacing = thin(beams[:, 2:])
        return cls(low, _log_ratios(squared, passes, mean_range), points, spacing / look_m)


def thin(points: FloatArray) -> tuple[FloatArray, float]:
    """The first point in every square, at most 300, (M, 2), and the side of the squares, m: the least, from 0.1 on."""
    spacing = 0.1
    while True:
        squares = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
        _, first = np.unique(squares[:, 0] * (squares[:, 1].max() + 1) + squares[:, 1], return_index=True)
        if first.size <= 300:
            return points[np.sort(first)], spacing
        spacing *= 1.25


def _log_ratios(squared: np.ndarray, passes: np.ndarray, mean_range: float) -> FloatArray:
    """A return near a surface: normal about it, or novel; where beams went through: novel; in the unknown: anything."""
    steps = np.arange(2 * _REACH**2 + 1) * CELL_M**2
    normal = np.exp(-0.5 * steps / SIGMA_M**2) / (np.sqrt(2.0 * np.pi) * SIGMA_M)
    by_step = np.append(np.log((1.0 - NOVEL_SHARE) * normal * mean_range + NOVEL_SHARE), 0.0)
    free = (squared == len(steps)) & (passes >= 2)
    return np.where(free, np.log(NOVEL_SHARE), by_step[squared])


def beams_of(scan: LaserScan, ranges: FloatArray, body_T_sensor: FloatArray) -> list[FloatArray]:
    """Beams of a level laser that met a surface, in the body's plane of motion, rows (x0, y0, x1, y1), shape (N, 4).

    In a list: none from a laser whose scan plane leans from the body's by more than some degrees, for it sees other
    walls from elsewhere.
    """
    if abs(body_T_sensor[2, 2]) < LEVEL_COSINE:
        return []
    away = np.stack((np.cos(scan.angles), np.sin(scan.angles)), axis=1) * ranges[:, None]
    # a return is of a surface when a neighbouring beam's is near: others graze it, or hit its edge
    near, seen = np.linalg.norm(np.diff(away, axis=0), axis=1) <= 0.3, np.zeros(len(ranges), dtype=bool)
    seen[1:] |= near
    seen[:-1] |= near
    away = away[seen]
    ends = away @ body_T_sensor[:2, :2].T + body_T_sensor[:2, 3]
    return [np.hstack((np.broadcast_to(body_T_sensor[:2, 3], ends.shape), ends))]


def moved(beams: FloatArray, pose: FloatArray) -> FloatArray:
    """Beams (N, 4) through a planar (4, 4) transform."""
    ends = beams.reshape(-1, 2) @ pose[:2, :2].T + pose[:2, 3]
    return ends.reshape(-1, 4)


def view_from(base: FloatArray, poses: Sequence[FloatArray], views: Sequence[FloatArray]) -> FloatArray:
    """Beams of several bodies in the frame of another one, all (4, 4) poses of one world, shape (N, 4)."""
    to_base = np.linalg.inv(base)
    return np.concatenate([moved(view, to_base @ pose) for pose, view in zip(poses, views, strict=True)])


def free_standing(away: FloatArray, angle_step: float) -> np.ndarray:
    """Which thing that stands free each return is of, shape (N,): a number from 0 on; -1: of none.

    A thing is what lies between two gaps. It stands free where the returns on both sides of it are farther from the
    sensor; beyond the ends of a fan nothing is known to be nearer, and what is cut off there may walk as well. A fan
    without ends goes on from its last return to its first.

    Args:
        away: returns in the order of the beams, from the sensor, shape (N, 2), m.
        angle_step: between two beams, rad.
    """
    none = np.full(len(away), -1, dtype=np.int64)
    if len(away) < 3:
        return none
    ranges = np.hypot(away[:, 0], away[:, 1])
    gaps = np.hypot(*(_begun_at(away, 1) - away).T) >= np.maximum(LEAST_GAP_M, GAP_STEPS * angle_step * ranges)
    between_ends = np.arctan2(away[0, 1], away[0, 0]) - np.arctan2(away[-1, 1], away[-1, 0])
    is_closed = abs(np.remainder(between_ends + np.pi, 2.0 * np.pi) - np.pi) < GAP_STEPS * angle_step
    if is_closed and not gaps.any():
        return none
    start = int(np.argmax(gaps)) + 1 if is_closed else 0  # a thing begins here
    turned, near, ends = (_begun_at(one, start) for one in (away, ranges, gaps))
    ends[-1] = True
    last = np.flatnonzero(ends)
    first = np.concatenate(([0], last[:-1] + 1))
    before, after = near[first - 1], near[(last + 1) % len(near)]
    if not is_closed:
        before[0] = after[-1] = np.inf
    free = (before > near[first]) & (after > near[last])
    extent = np.maximum.reduceat(turned, first) - np.minimum.reduceat(turned, first)
    free &= np.hypot(extent[:, 0], extent[:, 1]) < MOVABLE_M
    numbers = np.where(free, np.cumsum(free) - 1, -1)
    return _begun_at(np.repeat(numbers, last - first + 1), len(away) - start)


def _begun_at(rows: np.ndarray, start: int) -> np.ndarray:
    """The same rows (N, ...) in a circle from another one on; `numpy.roll` takes ten times as long for a scan."""
    return np.concatenate((rows[start:], rows[:start]))
