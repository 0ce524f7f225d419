"""Factors from lines seen by 2D lasers: two points on a plane."""

from __future__ import annotations

import gtsam
import numpy as np

from factors._check import as_definite_covariance, as_key
from factors._custom import Recipe
from factors.robust import Robust
from spplanes import ScanLine
from spplanes._check import FloatArray, as_transform


def line_factor(
    line: ScanLine,
    body_T_sensor: FloatArray,
    pose_key: int,
    plane_key: int,
    *,
    anchor_key: int | None = None,
    robust: Robust = None,
) -> gtsam.CustomFactor:
    """Factor of a line seen by a 2D laser mounted at ``body_T_sensor`` (4, 4) on the pose ``pose_key``.

    Rank-2 information on the same landmark as `factors.plane_factor`, exact for every mount and every tilt of the
    plane: the error is the distance, within the scan plane, of two points of the measured line to the line in which the
    landmark cuts the scan plane. A landmark within about 1 degree of the scan plane cuts it nowhere useful: from there
    on the error is bounded instead of exploding. The error is blind to the side the plane was seen from.
    ValueError: a key that is no integer, a singular covariance, no rigid transform, an unknown kernel.
    """
    return _recipe(line, body_T_sensor, pose_key, plane_key, anchor_key, robust, planar=False).factor()


def line_factor_2d(
    line: ScanLine,
    body_T_sensor: FloatArray,
    pose_key: int,
    plane_key: int,
    *,
    anchor_key: int | None = None,
    robust: Robust = None,
) -> gtsam.CustomFactor:
    """As `line_factor` with ``Pose2`` variables: a robot on the plane z = 0, the landmark an ``OrientedPlane3`` still.

    A horizontal laser alone does not tell how a wall leans: hold it with `factors.upright_prior`.
    """
    return _recipe(line, body_T_sensor, pose_key, plane_key, anchor_key, robust, planar=True).factor()


def decorrelated_points(line: ScanLine) -> tuple[FloatArray, float]:
    """Two points of the line, shape (2, 2), whose errors across it are independent, and their standard deviation.

    At position s along the line the error across it is drho - s dalpha. It is independent of dalpha at
    s0 = C_ar / C_aa, where its deviation is t; at s0 +- t / sigma_alpha the two errors are independent, each of
    deviation sqrt(2) t. Together they are the covariance of (alpha, rho) exactly.
    """
    covariance = as_definite_covariance("line.covariance", line.covariance, 2)
    position = covariance[0, 1] / covariance[0, 0]
    spread = np.sqrt(covariance[1, 1] - covariance[0, 1] * position)
    c, s = np.cos(line.alpha), np.sin(line.alpha)
    along = position + np.array([-1.0, 1.0]) * spread / np.sqrt(covariance[0, 0])
    points = line.rho * np.array([c, s]) + along[:, None] * np.array([-s, c])
    return points, float(np.sqrt(2.0) * spread)


def _recipe(
    line: ScanLine,
    body_T_sensor: FloatArray,
    pose_key: int,
    plane_key: int,
    anchor_key: int | None,
    robust: Robust,
    *,
    planar: bool,
) -> Recipe:
    points, sigma = decorrelated_points(line)
    return Recipe(
        kernel="line",
        data=(as_transform("body_T_sensor", body_T_sensor), points),
        root_information=np.eye(2) / sigma,
        dof=2,
        plane_key=as_key("plane_key", plane_key),
        pose_key=as_key("pose_key", pose_key),
        anchor_key=None if anchor_key is None else as_key("anchor_key", anchor_key),
        planar=planar,
        robust=robust,
    )
