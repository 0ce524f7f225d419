"""Callbacks of ``gtsam.CustomFactor`` around the compiled kernels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from spplanes._check import FloatArray

#: (world_T_anchor, world_T_body, coefficients) -> error (m,), derivative (m, 15)
Kernel = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]

_IDENTITY = np.asfortranarray(np.eye(4))


def landmark_factor(
    kernel: Callable[..., tuple[FloatArray, FloatArray]],
    data: tuple[Any, ...],
    noise: gtsam.noiseModel.Base,
    plane_key: int,
    pose_key: int | None = None,
    anchor_key: int | None = None,
) -> gtsam.CustomFactor:
    """Factor with the error ``kernel(world_T_anchor, world_T_body, coefficients, *data)``.

    Keys are (pose, anchor, plane), those that are given. A pose that is its own anchor drops out: seen from there the
    landmark does not depend on it.
    """
    if pose_key == anchor_key or pose_key is None:
        return gtsam.CustomFactor(noise, [plane_key], _unary(kernel, data, plane_key))
    if anchor_key is None:
        return gtsam.CustomFactor(noise, [pose_key, plane_key], _binary(kernel, data, pose_key, plane_key))
    keys = [pose_key, anchor_key, plane_key]
    return gtsam.CustomFactor(noise, keys, _ternary(kernel, data, pose_key, anchor_key, plane_key))


def _unary(kernel: Callable[..., Any], data: tuple[Any, ...], plane_key: int) -> Callable[..., Any]:
    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> FloatArray:
        coefficients = values.atOrientedPlane3(plane_key).planeCoefficients()
        residual, derivative = kernel(_IDENTITY, _IDENTITY, coefficients, *data)
        if jacobians is not None:
            jacobians[0] = derivative[:, 12:]
        return residual

    return error


def _binary(kernel: Callable[..., Any], data: tuple[Any, ...], pose_key: int, plane_key: int) -> Callable[..., Any]:
    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> FloatArray:
        coefficients = values.atOrientedPlane3(plane_key).planeCoefficients()
        residual, derivative = kernel(_IDENTITY, values.atPose3(pose_key).matrix(), coefficients, *data)
        if jacobians is not None:
            jacobians[0] = derivative[:, :6]
            jacobians[1] = derivative[:, 12:]
        return residual

    return error


def _ternary(
    kernel: Callable[..., Any], data: tuple[Any, ...], pose_key: int, anchor_key: int, plane_key: int
) -> Callable[..., Any]:
    def error(_: gtsam.CustomFactor, values: gtsam.Values, jacobians: Any) -> FloatArray:
        coefficients = values.atOrientedPlane3(plane_key).planeCoefficients()
        world_T_anchor = values.atPose3(anchor_key).matrix()
        residual, derivative = kernel(world_T_anchor, values.atPose3(pose_key).matrix(), coefficients, *data)
        if jacobians is not None:
            jacobians[0] = derivative[:, :6]
            jacobians[1] = derivative[:, 6:12]
            jacobians[2] = derivative[:, 12:]
        return residual

    return error
