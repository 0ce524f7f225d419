"""Scans and odometry out of the table of a CARMEN log, each made when it is asked for."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from slam.geometry.frames import planar_transform
from slam.io.spool import Spool
from spplanes._check import FloatArray


@dataclass(frozen=True, eq=False)
class TableScans:
    """What the scans of one laser have in common."""

    rows: np.ndarray
    """The table: dtype `slam.io.carmen._stream.ROW`."""
    spool: Spool
    """Ranges as written."""
    least_m: float
    """Ranges up to this are no returns."""
    limit_m: float
    """Ranges at or beyond this are none."""
    mount: FloatArray | None
    """body_T_sensor as the log tells it, shape (4, 4)."""
    first_angle_deg: float | None
    """As the rig tells it; None: it does not."""
    angle_step_deg: float | None
    """As the rig tells it; None: it does not."""
    _bearings: dict[tuple[float, ...], FloatArray] = field(default_factory=dict)
    """Those made already: scan after scan has the same."""

    def ranges(self, row: int) -> FloatArray:
        """Ranges of a record, shape (B,), m; NaN = no return."""
        record = self.rows[row]
        written = self.spool.get(int(record["place"]), int(record["beams"]))
        return np.where((written > self.least_m) & (written < self.limit_m), written, np.nan)

    def angles(self, count: int, start: float, step: float) -> FloatArray:
        """Bearings, shape (B,), rad: the rig's, else the record's, else those of a SICK with that many beams."""
        key = (count, start, step) if np.isfinite(start) else (count,)  # NaN is never the same
        if key not in self._bearings:
            self._bearings[key] = self._bearings_of(count, start, step)
        return self._bearings[key]

    def _bearings_of(self, count: int, start: float, step: float) -> FloatArray:
        if self.first_angle_deg is not None and self.angle_step_deg is not None:
            degrees = self.first_angle_deg + self.angle_step_deg * np.arange(count, dtype=np.float64)
            return np.asarray(np.deg2rad(degrees), dtype=np.float64)
        if np.isfinite(start):
            return start + step * np.arange(count, dtype=np.float64)
        return np.pi * np.arange(count, dtype=np.float64) / max(count - count % 2, 1) - np.pi / 2.0

    def pose(self, row: int) -> FloatArray | None:
        """world_T_body of a record, shape (4, 4); None: it gives none."""
        record = self.rows[row]
        if np.isfinite(record["start"]):
            return robot_pose(self.rows, row) if np.isfinite(record["robot_pose"][0]) else None
        world_T_laser = planar_transform(*record["laser_pose"])
        return world_T_laser if self._laser_T_body is None else world_T_laser @ self._laser_T_body

    @cached_property
    def _laser_T_body(self) -> FloatArray | None:
        return None if self.mount is None else np.linalg.inv(self.mount).astype(np.float64, copy=False)


def robot_pose(rows: np.ndarray, row: int) -> FloatArray:
    """Pose of the robot that a record gives, shape (4, 4)."""
    return planar_transform(*rows[row]["robot_pose"])
