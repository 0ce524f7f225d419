"""Measurements of a keyframe's pose that are of no plane: gravity from an IMU, and what else a robot knows of itself.

A new kind is a frozen dataclass of numbers and arrays with a method `factor`, named in `KINDS`: sessions write it, the
graph takes it, and it leaves with its keyframe.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from factors import gravity_factor
from spplanes._check import FloatArray


class PoseMeasurement(Protocol):
    """What a keyframe knows of its own pose."""

    def factor(self, pose_key: int) -> Any:
        """Its factor on the Pose3 under `pose_key`."""
        ...


@dataclass(frozen=True, eq=False)
class GravityMeasurement:
    """Which way is up, as an IMU at rest or in even motion feels it."""

    up_in_body: FloatArray
    """Direction against gravity in the body's axes, shape (3,), of any length."""
    sigma_rad: float
    """Standard deviation of roll and of pitch, rad."""

    def factor(self, pose_key: int) -> Any:
        """A native factor that holds roll and pitch."""
        return gravity_factor(pose_key, self.up_in_body, self.sigma_rad)


#: Every kind that sessions know.
KINDS: tuple[type, ...] = (GravityMeasurement,)
