"""Where a sensor sits on the robot, as rig.yaml says it."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from spplanes._check import FloatArray, as_transform
from spplanes.spmodel import transform_from_rpy

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Triple = tuple[Finite, Finite, Finite]


class Frozen(BaseModel):
    """What all parts of a rig are: unchangeable, and strict about the keys they know."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_by_name=True, validate_by_alias=True)


class Mount(Frozen):
    """Where a sensor sits: body_T_sensor as position and roll, pitch, yaw, or as a 4x4 matrix, never both.

    R = Rz(yaw) Ry(pitch) Rx(roll). The body frame is x forward, y left, z up, its origin on the floor.
    """

    xyz_m: Triple = (0.0, 0.0, 0.0)
    """Position of the sensor in the body frame, m."""
    rpy_deg: Triple = (0.0, 0.0, 0.0)
    """Roll, pitch, yaw of the sensor in the body frame, deg."""
    matrix: tuple[tuple[Finite, ...], ...] | None = None
    """The whole (4, 4) transform, in place of xyz_m and rpy_deg."""

    @model_validator(mode="before")
    @classmethod
    def _from_rows(cls, value: Any) -> Any:
        return {"matrix": value} if isinstance(value, (list, tuple)) else value

    @model_validator(mode="after")
    def _check_matrix(self) -> Mount:
        if self.matrix is not None:
            if {"xyz_m", "rpy_deg"} & self.model_fields_set:
                raise ValueError("expected xyz_m and rpy_deg or a 4x4 matrix, got both")
            as_transform("body_T_sensor", [list(row) for row in self.matrix])
        return self

    def as_matrix(self) -> FloatArray:
        """body_T_sensor, shape (4, 4)."""
        if self.matrix is not None:
            return np.array(self.matrix, dtype=np.float64)
        transform = transform_from_rpy((*self.xyz_m, *np.deg2rad(self.rpy_deg)[::-1]))
        rotation = transform[:3, :3]
        rotation[np.abs(rotation) < 1e-15] = 0.0  # at quarter turns
        return transform
