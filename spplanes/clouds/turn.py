"""The turn of a spinning lidar: where it began, by the order in which the points of a cloud come."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spplanes._check import FloatArray

#: Points without rows are looked at in so many pieces, whether each is narrow (by the length of the mean direction) and
#: nearly all lead the same way, once round, or nearly so where something stands beside the sensor.
_PIECES, _NARROW, _MOST, _ROUND = 256, 0.8, 0.9, (0.7, 1.05)


class TurnBegin(NamedTuple):
    """Where a turn of a spinning lidar begins."""

    azimuth_rad: float = -np.pi
    """About the sensor's z, from x on."""
    clockwise: bool = False
    """Whether it turns so, seen from above."""

    def turned(self, points: FloatArray) -> FloatArray:
        """Share of the turn that is over when each of points (N, 3) in the sensor's frame is seen, 0 to 1, (N,)."""
        way = -1.0 if self.clockwise else 1.0
        return np.mod(way * (np.arctan2(points[:, 1], points[:, 0]) - self.azimuth_rad) / (2.0 * np.pi), 1.0)


def begin_of(points: FloatArray) -> TurnBegin | None:
    """Where a turn begins, by the order of its points, (N, 3) or (S, B, 3) with columns in a row or one beneath the
    other; None: they are in no order of time, or no one turn.
    """
    pieces = _PIECES * (len(points) // _PIECES)
    orders = (points, points.swapaxes(0, 1)) if points.ndim == 3 else (points[:pieces].reshape(_PIECES, -1, 3),)
    for order in orders:
        flat = np.hypot(order[..., 0], order[..., 1])
        seen = flat > 0.0
        count = np.maximum(seen.sum(axis=1), 1)
        x, y = (np.where(seen, order[..., k] / np.where(seen, flat, 1.0), 0.0).sum(axis=1) / count for k in (0, 1))
        narrow = np.hypot(x, y) > _NARROW
        if np.count_nonzero(narrow) < max(_MOST * np.count_nonzero(seen.any(axis=1)), _PIECES // 4):
            continue
        azimuths = np.arctan2(y, x)[narrow]
        steps = np.angle(np.exp(1j * np.diff(azimuths)))
        turns = float(steps.sum()) / (2.0 * np.pi)
        if _ROUND[0] <= abs(turns) <= _ROUND[1] and np.mean(steps * turns > 0.0) >= _MOST:
            return TurnBegin(float(azimuths[0] - 0.5 * np.median(steps)), turns < 0.0)
    return None


def told_turn(points: FloatArray) -> tuple[float, float]:
    """The same as numbers: azimuth, rad, and 1 or -1 (clockwise); 0: none is shown."""
    begin = begin_of(points)
    return (0.0, 0.0) if begin is None else (begin.azimuth_rad, -1.0 if begin.clockwise else 1.0)
