"""Measurements of a keyframe's pose that are of no plane: gravity from an IMU, places, and what else a robot knows.

A new kind of what a keyframe knows of its own pose is a frozen dataclass of numbers and arrays with a method `factor`,
named in `KINDS`: sessions write it, the graph takes it, and it leaves with its keyframe. A `PlaceMatch` is of two
keyframes: loop closure and the prediction weigh it.
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


@dataclass(frozen=True, eq=False)
class PlaceMatch:
    """Where a keyframe is from an earlier one, as what was seen about both tells it."""

    keyframe: int
    """Index of the earlier one."""
    delta: FloatArray
    """The later one in its frame: on a floor (x, y, theta), shape (3,), else (x, y, z, phi, theta, psi), the turn about
    z first, shape (6,); m and rad."""
    covariance: FloatArray
    """Its covariance: on a floor additive, x and y along the axes of the earlier one, shape (3, 3); else SP order along
    the axes of the later one, shape (6, 6)."""
    inferred: bool = False
    """Whether it follows from what was measured elsewhere: a hint where to look for planes seen before, no measurement
    of its own."""

    @property
    def is_spatial(self) -> bool:
        """Whether it is of a body on no floor: its motion to there is known by this, whatever was measured of it."""
        return len(self.delta) > 3


#: Every kind that sessions know.
KINDS: tuple[type, ...] = (GravityMeasurement,)
