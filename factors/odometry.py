"""Factors from 2D odometry, and from driving on a floor."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors._check import as_definite_covariance, as_key, check_distinct
from factors.robust import Robust, with_robust
from spplanes._check import FloatArray, as_number, as_positive, as_shape

#: Stated sigmas of what wheels do not measure in one step: z (m), roll (rad), pitch (rad).
OUT_OF_PLANE_SIGMAS = (0.01, 0.005, 0.005)

#: Stands for "no information": infinity does not survive GTSAM's text archives.
_UNKNOWN_SIGMA = 1e8


def odometry_factor(
    key_a: int,
    key_b: int,
    delta: ArrayLike | gtsam.Pose2,
    covariance: ArrayLike,
    *,
    out_of_plane_sigmas: Sequence[float] = OUT_OF_PLANE_SIGMAS,
    robust: Robust = None,
) -> gtsam.BetweenFactorPose3:
    """2D odometry between two Pose3: ``delta`` = (x, y, theta), m and rad, or the Pose2, of b in the frame of a.

    ``covariance`` (3, 3) is that of the three numbers, x and y along the axes of a. Out of the plane the motion is zero
    up to ``out_of_plane_sigmas`` = (z m, roll rad, pitch rad), per step, along the axes of b.
    ValueError: wrong shapes, an angle beyond a full turn (degrees, most likely), keys that are no integers, a singular
    covariance, sigmas that are not positive.
    """
    check_distinct(key_a=key_a, key_b=key_b)
    x, y, theta = _x_y_theta(delta)
    full = np.zeros((6, 6))
    in_plane = np.ix_([3, 4, 2], [3, 4, 2])
    full[in_plane] = _in_frame_of_b(theta, as_definite_covariance("covariance", covariance, 3))
    z, roll, pitch = _sigmas("out_of_plane_sigmas", out_of_plane_sigmas)
    full[5, 5], full[0, 0], full[1, 1] = z**2, roll**2, pitch**2
    motion = gtsam.Pose3(gtsam.Rot3.Yaw(theta), np.array([x, y, 0.0]))
    noise = with_robust(gtsam.noiseModel.Gaussian.Covariance(full), robust, 6)
    return gtsam.BetweenFactorPose3(as_key("key_a", key_a), as_key("key_b", key_b), motion, noise)


def odometry_factor_2d(
    key_a: int, key_b: int, delta: ArrayLike | gtsam.Pose2, covariance: ArrayLike, *, robust: Robust = None
) -> gtsam.BetweenFactorPose2:
    """2D odometry between two Pose2; arguments as in `odometry_factor`."""
    check_distinct(key_a=key_a, key_b=key_b)
    x, y, theta = _x_y_theta(delta)
    own = _in_frame_of_b(theta, as_definite_covariance("covariance", covariance, 3))
    noise = with_robust(gtsam.noiseModel.Gaussian.Covariance(own), robust, 3)
    return gtsam.BetweenFactorPose2(as_key("key_a", key_a), as_key("key_b", key_b), gtsam.Pose2(x, y, theta), noise)


def planar_motion_factor(
    pose_key: int, *, height: float = 0.0, sigmas: Sequence[float] = OUT_OF_PLANE_SIGMAS, robust: Robust = None
) -> gtsam.NonlinearFactorGraph:
    """A robot that stays on a level floor: z = ``height``, roll = pitch = 0, up to ``sigmas`` = (z m, roll, pitch rad).

    Two native factors, in a graph to ``push_back``: no single native one leaves x, y and yaw free and couples nothing.
    Tilt is measured in the world's horizontal axes, so roll and pitch share the larger sigma. It holds the robot to the
    floor of the *world*: once, or at every pose; `odometry_factor` alone lets z and tilt wander step by step.
    """
    key = as_key("pose_key", pose_key)
    z, roll, pitch = _sigmas("sigmas", sigmas)
    free_xy = gtsam.noiseModel.Diagonal.Sigmas(np.array([_UNKNOWN_SIGMA, _UNKNOWN_SIGMA, z]))
    graph = gtsam.NonlinearFactorGraph()
    at_height = np.array([0.0, 0.0, as_number("height", height)])
    graph.push_back(gtsam.PoseTranslationPrior3D(key, at_height, with_robust(free_xy, robust, 1)))
    tilt = with_robust(gtsam.noiseModel.Isotropic.Sigma(2, max(roll, pitch)), robust, 2)
    graph.push_back(gtsam.AttitudeFactorPose3(key, gtsam.Unit3(0.0, 0.0, 1.0), tilt))
    return graph


def _x_y_theta(delta: ArrayLike | gtsam.Pose2) -> FloatArray:
    """x, y, theta of a planar motion, m and rad, shape (3,)."""
    if isinstance(delta, gtsam.Pose2):
        return np.array([delta.x(), delta.y(), delta.theta()])
    numbers = as_shape("delta", delta, (3,))
    if abs(numbers[2]) > 2.0 * np.pi:
        raise ValueError(f"delta: expected an angle of at most a full turn, in rad, got {numbers[2]:g}")
    return numbers


def _in_frame_of_b(theta: float, covariance: FloatArray) -> FloatArray:
    """Covariance of (x, y, theta) additive in a's axes, turned to b's axes, where GTSAM's tangent lives."""
    c, s = np.cos(theta), np.sin(theta)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return turn @ covariance @ turn.T


def _sigmas(name: str, values: Sequence[float]) -> tuple[float, float, float]:
    z, roll, pitch = as_shape(name, values, (3,))
    return as_positive(name, z), as_positive(name, roll), as_positive(name, pitch)
