"""Factors of what is known about planes without having measured it: levels, plumb walls, right angles, heights."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors._check import as_anchor, as_key, check_distinct, told_key
from factors._custom import Recipe
from factors._kernels import unit_basis
from factors.robust import Robust
from spplanes._check import FloatArray, as_number, as_positive, as_shape


def direction_prior(
    plane_key: int, direction: ArrayLike, sigma_rad: float, *, anchor_key: int | None = None, robust: Robust = None
) -> gtsam.NonlinearFactor:
    """The plane's normal is along ``direction`` (3,) in the world: a level floor, its ``direction`` against gravity.

    ``sigma_rad`` is the standard deviation of each of the two tilts. Blind to sign. Native for landmarks in the world
    without a robust kernel, which the native factor does not take.
    """
    towards = _unit("direction", direction)
    sigma = as_positive("sigma_rad", sigma_rad)
    if anchor_key is None and robust is None:
        noise = gtsam.noiseModel.Isotropic.Sigma(2, sigma)
        return gtsam.OrientedPlane3DirectionPrior(as_key("plane_key", plane_key), np.array([*towards, 0.0]), noise)
    return _along(plane_key, np.ascontiguousarray(unit_basis(towards).T), sigma, anchor_key, robust)


def upright_prior(
    plane_key: int, sigma_rad: float, *, up: ArrayLike = (0, 0, 1), anchor_key: int | None = None, robust: Robust = None
) -> gtsam.CustomFactor:
    """The plane is plumb: its normal is at right angles to ``up`` (3,) in the world; one degree of freedom."""
    return _along(plane_key, _unit("up", up)[None], as_positive("sigma_rad", sigma_rad), anchor_key, robust)


def parallel_factor(
    plane_a: int,
    plane_b: int,
    sigma_rad: float,
    *,
    anchor_a: int | None = None,
    anchor_b: int | None = None,
    robust: Robust = None,
) -> gtsam.CustomFactor:
    """Two plane landmarks are parallel, facing the same or opposite ways; two tilts of deviation ``sigma_rad`` each.

    ``anchor_a`` and ``anchor_b`` are the poses in whose frames they live, None for the world.
    """
    root = np.eye(3) / as_positive("sigma_rad", sigma_rad)
    return _pair("parallel", (), root, 2, (plane_a, plane_b), (anchor_a, anchor_b), robust)


def perpendicular_factor(
    plane_a: int,
    plane_b: int,
    sigma_rad: float,
    *,
    anchor_a: int | None = None,
    anchor_b: int | None = None,
    robust: Robust = None,
) -> gtsam.CustomFactor:
    """Two plane landmarks are at right angles, up to ``sigma_rad``; arguments as in `parallel_factor`."""
    root = np.eye(1) / as_positive("sigma_rad", sigma_rad)
    return _pair("perpendicular", (), root, 1, (plane_a, plane_b), (anchor_a, anchor_b), robust)


def distance_factor(
    plane_a: int,
    plane_b: int,
    distance_m: float,
    sigma_m: float,
    *,
    at: ArrayLike = (0.0, 0.0, 0.0),
    anchor_a: int | None = None,
    anchor_b: int | None = None,
    robust: Robust = None,
) -> gtsam.CustomFactor:
    """Known distance between two parallel planes: from a to b, positive along the normal of a.

    Floor to ceiling is positive, as are two walls that face each other; front to back of one wall is negative.
    It is measured where ``at`` (3,), in the frame plane a lives in, drops onto plane a. One degree of freedom: that
    they are parallel is `parallel_factor`'s to say.
    """
    data = (np.array([as_number("distance_m", distance_m)]), as_shape("at", at, (3,)).copy())
    root = np.eye(1) / as_positive("sigma_m", sigma_m)
    return _pair("distance", data, root, 1, (plane_a, plane_b), (anchor_a, anchor_b), robust)


def _along(
    plane_key: int, directions: FloatArray, sigma: float, anchor_key: int | None, robust: Robust
) -> gtsam.CustomFactor:
    check_distinct(anchor_key=anchor_key, plane_key=plane_key)
    key, anchor = as_key("plane_key", plane_key), as_anchor("anchor_key", anchor_key)
    root, dof = np.eye(len(directions)) / sigma, len(directions)
    return Recipe("direction", (directions,), root, dof, key, anchor_key=anchor, robust=robust).factor()


def _pair(
    kernel: str,
    data: tuple[FloatArray, ...],
    root: FloatArray,
    dof: int,
    planes: tuple[int, int],
    anchors: tuple[int | None, int | None],
    robust: Robust,
) -> gtsam.CustomFactor:
    (plane_a, plane_b), (anchor_a, anchor_b) = planes, anchors
    if as_key("plane_a", plane_a) == as_key("plane_b", plane_b):
        raise ValueError(f"plane_b: expected another landmark than plane_a, got the same key {told_key(plane_b)}")
    check_distinct(plane_a=int(plane_a), plane_b=int(plane_b), anchor_a=anchor_a)
    check_distinct(plane_a=int(plane_a), plane_b=int(plane_b), anchor_b=anchor_b)
    keys = int(plane_b), as_anchor("anchor_a", anchor_a), as_anchor("anchor_b", anchor_b), int(plane_a)
    return Recipe(kernel, data, root, dof, *keys, robust=robust).factor()


def _unit(name: str, value: ArrayLike) -> FloatArray:
    vector = as_shape(name, value, (3,))
    largest = float(np.abs(vector).max())
    if largest == 0.0:
        raise ValueError(f"{name}: expected a direction, got the zero vector")
    vector = vector / largest  # first, lest squares overflow
    return vector / np.linalg.norm(vector)
