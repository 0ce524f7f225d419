"""Factors from lines seen by 2D lasers: two points on a plane."""

from __future__ import annotations

from functools import lru_cache
from math import cos, hypot, isfinite, sin, sqrt

import gtsam
import gtsam_unstable
import numpy as np
from numpy.typing import ArrayLike

from factors._check import as_anchor, as_definite_covariance, as_key, check_distinct
from factors._conventions import landmark_hesse, oriented_plane
from factors._custom import Recipe
from factors._kernels import GRAZING, two_point_information
from factors.robust import Robust, gaussian
from spplanes import ScanLine
from spplanes._check import FloatArray, as_transform, check_instance


def line_factor(
    line: ScanLine,
    body_T_sensor: gtsam.Pose3 | ArrayLike,
    pose_key: int,
    plane_key: int,
    *,
    anchor_key: int | None = None,
    expected: gtsam.OrientedPlane3 | None = None,
    robust: Robust = None,
) -> gtsam.NonlinearFactor:
    """Factor of a line seen by a 2D laser mounted at ``body_T_sensor``, a pose or (4, 4), on the pose ``pose_key``.

    Rank-2 information on the same landmark as `factors.plane_factor`, for every mount and every tilt of the plane: the
    error is the distance, within the scan plane, of two points of the measured line to the line in which the landmark
    cuts the scan plane. A landmark within about 1 degree of the scan plane cuts it nowhere useful: from there on the
    error is bounded instead of exploding. The error is blind to the side the plane was seen from.

    With ``expected``, the landmark as the body should see it, and an anchor other than the pose, the factor is native:
    the distances of the points from the landmark itself, over the sine of the angle of ``expected`` to the scan plane.
    Only that angle is used: where it is off by a degree, distances stay exact and their weight is off by 2 % at 45
    degrees, by nothing at right angles. Native is what large graphs need: inside an optimiser every call of a custom
    factor copies all values.
    ValueError: a key that is no integer, a singular covariance, no rigid transform, an unknown kernel, an
    ``expected`` plane without ``anchor_key`` or within about 1 degree of the scan plane.
    """
    recipe = _recipe(line, body_T_sensor, pose_key, plane_key, anchor_key, robust, planar=False)
    if expected is None:
        return recipe.factor()
    check_instance("expected", expected, gtsam.OrientedPlane3)
    if recipe.anchor_key is None:
        raise ValueError(
            "expected: expected an anchor_key with it, got none: a landmark in the world has no native factor"
        )
    if recipe.anchor_key == recipe.pose_key:
        return recipe.factor()
    return _native(recipe, landmark_hesse(expected)[0])


def line_factor_2d(
    line: ScanLine,
    body_T_sensor: gtsam.Pose3 | ArrayLike,
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


@lru_cache(maxsize=64)  # of the lines of a keyframe, each of which is compared with several landmarks
def _decorrelated_points(line: ScanLine) -> tuple[FloatArray, float]:
    """Two points of the line, shape (2, 2), whose errors across it are independent, and their standard deviation.

    At position s along the line the error across it is drho - s dalpha. It is independent of dalpha at
    s0 = C_ar / C_aa, where its deviation is t; at s0 +- t / sigma_alpha the two errors are independent, each of
    deviation sqrt(2) t. Together they are the covariance of (alpha, rho) exactly.
    """
    (a, b), (b2, r) = line.covariance.tolist()
    if not (b == b2 and a > 0.0 and r > 0.0 and isfinite(a + r) and b * b < (1.0 - 1e-9) * (a * r)):  # most by a glance
        (a, b), (_, r) = as_definite_covariance("line.covariance", line.covariance, 2).tolist()
    position = b / a
    spread = sqrt(r - b * position)
    c, s = cos(line.alpha), sin(line.alpha)
    reach = spread / sqrt(a)
    points = [(line.rho * c - along * s, line.rho * s + along * c) for along in (position - reach, position + reach)]
    return np.array(points), sqrt(2.0) * spread


def _native(recipe: Recipe, normal: FloatArray) -> gtsam.NonlinearFactor:
    """The recipe of an anchored line as a native factor, for a landmark of about this ``normal`` (3,) in the body."""
    mount, points = (np.asarray(array) for array in recipe.data)
    cut = hypot(*(normal @ mount[:3, :2]).tolist())
    if cut < GRAZING:
        raise ValueError(f"expected: expected a plane that cuts the scan plane, got one at {cut:.3g} rad to it")
    in_body = points @ mount[:3, :2].T + mount[:3, 3]
    measured, root = two_point_information(in_body, cut / recipe.root_information[0, 0])
    keys = [key for key in (recipe.pose_key, recipe.anchor_key, recipe.plane_key) if key is not None]
    noise = gaussian(root, recipe.robust, 2)
    return gtsam_unstable.LocalOrientedPlane3Factor(oriented_plane(measured, 0.0), noise, *keys)


def _recipe(
    line: ScanLine,
    body_T_sensor: gtsam.Pose3 | ArrayLike,
    pose_key: int,
    plane_key: int,
    anchor_key: int | None,
    robust: Robust,
    *,
    planar: bool,
) -> Recipe:
    check_instance("line", line, ScanLine)
    points, sigma = _decorrelated_points(line)
    check_distinct(pose_key=pose_key, plane_key=plane_key)
    check_distinct(anchor_key=anchor_key, plane_key=plane_key)
    keys = as_key("plane_key", plane_key), as_key("pose_key", pose_key), as_anchor("anchor_key", anchor_key)
    data = as_transform("body_T_sensor", body_T_sensor).copy(), points
    return Recipe("line", data, np.eye(2) / sigma, 2, *keys, planar=planar, robust=robust)
