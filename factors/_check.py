"""Input checks of the factor builders: keys and noise."""

from __future__ import annotations

import numbers
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_covariance, check_instance


def as_key(name: str, value: object) -> int:
    """Return a GTSAM key (``gtsam.symbol("x", 3)`` or a plain integer)."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or not 0 <= int(value) < 2**64:
        raise ValueError(f"{name}: expected a GTSAM key (an integer such as gtsam.symbol('x', 0)), got {value!r}")
    return int(value)


def as_anchor(name: str, value: object) -> int | None:
    """Return the GTSAM key of a pose in whose frame something is, or None: it is in the world."""
    return None if value is None else as_key(name, value)


def as_list(name: str, value: Any) -> list[Any]:
    """What a sequence holds; ValueError: it is none."""
    try:
        return list(value)
    except TypeError as error:
        raise ValueError(f"{name}: expected a sequence, got {type(value).__name__}") from error


def as_keys(name: str, value: Any) -> list[int]:
    """The GTSAM keys of a sequence of at least one; ValueError: it is none, or has one of them twice."""
    keys = [as_key(name, key) for key in as_list(name, value)]
    check_distinct(**{f"{name}[{i}]": key for i, key in enumerate(keys)})
    if not keys:
        raise ValueError(f"{name}: expected at least one, got none")
    return keys


def told_key(key: int) -> str:
    """A key as a reader knows it: x12 for ``gtsam.symbol("x", 12)``, plain integers as they are."""
    return str(gtsam.DefaultKeyFormatter(key))


def held(read: Callable[[int], Any], key: int) -> Any:
    """What one of GTSAM's readers (``values.atPose3``, say) has of a key; None: nothing of that type."""
    try:
        return read(key)
    except (IndexError, RuntimeError):
        return None


def pose_in(name: str, values: gtsam.Values, key: int) -> gtsam.Pose3:
    """A pose of values, a Pose2 as the Pose3 that it is; ValueError: there is none of that key."""
    check_instance("values", values, gtsam.Values)
    for read in (values.atPose3, values.atPose2):
        if (pose := held(read, as_key(name, key))) is not None:
            return gtsam.Pose3(pose)
    raise ValueError(f"{name}: expected the key of a Pose3 or Pose2 in values, got {told_key(key)}")


def plane_in(name: str, values: gtsam.Values, key: int) -> gtsam.OrientedPlane3:
    """A plane landmark of values; ValueError: there is none of that key."""
    check_instance("values", values, gtsam.Values)
    plane = held(values.atOrientedPlane3, as_key(name, key))
    if plane is None:
        raise ValueError(f"{name}: expected the key of an OrientedPlane3 in values, got {told_key(key)}")
    return plane


def check_distinct(**keys: int | None) -> None:
    """Refuse two keys of one factor that name the same variable, and what is no key; None names none."""
    seen: dict[int, str] = {}
    for name, value in keys.items():
        if value is None:
            continue
        key = as_key(name, value)
        if key in seen:
            raise ValueError(f"{name}: expected another key than {seen[key]}, got {told_key(key)} for both")
        seen[key] = name


def as_definite_covariance(name: str, value: ArrayLike, size: int) -> FloatArray:
    """Return a symmetric positive definite (size, size) covariance; a singular one has no information matrix."""
    matrix = as_covariance(name, value, size)
    check_definite(name, matrix[None])
    return matrix


def check_definite(name: str, covariances: FloatArray) -> None:
    """Refuse singular matrices among symmetric ones, shape (N, n, n); scale does not matter, only correlation."""
    scale = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    safe = np.where(scale > 0.0, scale, 1.0)
    smallest = np.linalg.eigvalsh(covariances / (safe[:, :, None] * safe[:, None, :]))[:, 0]
    bad = np.flatnonzero((scale < 1e-25).any(axis=1) | (smallest < 1e-12))  # no float holds 1 / sigma^2 of less
    if len(bad):
        where = f" at index {bad[0]}" if len(covariances) > 1 else ""
        raise ValueError(f"{name}: expected a positive definite covariance, got a singular one{where}")
