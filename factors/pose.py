"""Factors of poses: priors, motions, 2D odometry, gravity, driving on a floor; whole poses in the SPmodel's order."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors._check import as_definite_covariance, as_key, as_keys, check_distinct
from factors._conventions import SP_TO_POSE3, in_frame_of_end, planar_motion
from factors._custom import VelocityRecipe
from factors.robust import Robust, with_robust
from spplanes._check import FloatArray, as_number, as_positive, as_shape, as_transform

#: Stated sigmas of what wheels do not measure in one step: z (m), roll (rad), pitch (rad).
OUT_OF_PLANE_SIGMAS = (0.01, 0.005, 0.005)


def pose_prior(
    pose_key: int, world_T_body: gtsam.Pose3 | ArrayLike, covariance: ArrayLike, *, robust: Robust = None
) -> gtsam.PriorFactorPose3:
    """Prior on a Pose3: ``covariance`` (6, 6) of the SP differential (x, y, z, phi, theta, psi), on the right.

    ValueError: not a rigid transform, a singular covariance, a key that is no integer.
    """
    pose = gtsam.Pose3(as_transform("world_T_body", world_T_body))
    return gtsam.PriorFactorPose3(as_key("pose_key", pose_key), pose, _noise(covariance, robust))


def relative_pose_factor(
    key_a: int, key_b: int, a_T_b: gtsam.Pose3 | ArrayLike, covariance: ArrayLike, *, robust: Robust = None
) -> gtsam.BetweenFactorPose3:
    """Measured pose of b in the frame of a, Pose3 both: registration, loop closure, spatial odometry.

    ``covariance`` (6, 6) as in `pose_prior`, i.e. along the axes of b.
    ValueError: not a rigid transform, a singular covariance, keys that are no integers.
    """
    check_distinct(key_a=key_a, key_b=key_b)
    motion = gtsam.Pose3(as_transform("a_T_b", a_T_b))
    return gtsam.BetweenFactorPose3(as_key("key_a", key_a), as_key("key_b", key_b), motion, _noise(covariance, robust))


def constant_velocity_factor(
    keys: Sequence[int], covariance: ArrayLike, *, kept: ArrayLike = 1.0, robust: Robust = None
) -> gtsam.CustomFactor:
    """A body keeps its velocity: of three Pose3 a, b, c in order of time, b to c is the motion from a to b once more.

    A motion copied from the one before into a `relative_pose_factor` errs as that one does, and the next by both; n
    such factors, taken for independent, claim far less than the n^1.5 by which a body drifts whose velocity nobody
    sees. Here the velocity is the poses' own: what is seen later tells it as well.

    Args:
        keys: of a, b and c.
        covariance: of the change of the motion, (6, 6) as in `pose_prior`, along the axes of c.
        kept: how much of the motion goes on: the seconds from b to c over those from a to b; (6,) in the SP order where
            it differs by axis. A velocity of variance s^2 that is not to grow without bound keeps sqrt(1 - q / s^2)
            of itself where it changes by a variance q.
        robust: as in `factors.robust`.

    References:
        Barfoot, Tong, Sarkka, "Batch continuous-time trajectory estimation as exactly sparse Gaussian process
        regression", RSS 2014, for white noise on acceleration.
        Singer, "Estimating optimal tracking filter performance for manned maneuvering targets", 1970, for less than all
        of the velocity.

    ValueError: not three distinct keys, a singular covariance, shares that are no finite numbers.
    """
    numbers = as_keys("keys", keys)
    if len(numbers) != 3:
        raise ValueError(f"keys: expected three, got {len(numbers)}")
    full = as_definite_covariance("covariance", covariance, 6)[SP_TO_POSE3[:, None], SP_TO_POSE3]
    shares = as_shape("kept", np.broadcast_to(kept, (6,)) if np.ndim(kept) == 0 else kept, (6,))[SP_TO_POSE3]
    root = np.asarray(np.linalg.cholesky(np.linalg.inv(full)).T, dtype=np.float64)
    return VelocityRecipe((numbers[0], numbers[1], numbers[2]), shares, root, robust).factor()


def gravity_factor(
    pose_key: int, up_in_body: ArrayLike, sigma_rad: float, *, robust: Robust = None
) -> gtsam.AttitudeFactorPose3:
    """Measured direction against gravity, (3,) in the body's axes, of a robot that stands or rolls evenly: an IMU's.

    ``sigma_rad`` is the standard deviation of roll and of pitch; the heading stays free.
    ValueError: a direction of no length, a sigma that is not positive, a key that is no integer.
    """
    up = as_shape("up_in_body", up_in_body, (3,))
    if not np.linalg.norm(up) > 0.0:
        raise ValueError(f"up_in_body: expected a direction, got {up.tolist()}")
    noise = with_robust(gtsam.noiseModel.Isotropic.Sigma(2, as_positive("sigma_rad", sigma_rad)), robust, 2)
    return gtsam.AttitudeFactorPose3(as_key("pose_key", pose_key), gtsam.Unit3(0.0, 0.0, 1.0), noise, gtsam.Unit3(up))


def _noise(covariance: ArrayLike, robust: Robust) -> gtsam.noiseModel.Base:
    full = as_definite_covariance("covariance", covariance, 6)
    gaussian = gtsam.noiseModel.Gaussian.Covariance(full[SP_TO_POSE3[:, None], SP_TO_POSE3])
    return with_robust(gaussian, robust, 6)


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
    definite = as_definite_covariance("covariance", covariance, 3)
    sigmas = _sigmas("out_of_plane_sigmas", out_of_plane_sigmas)
    motion, full = planar_motion(_x_y_theta(delta), definite, sigmas)
    noise = with_robust(gtsam.noiseModel.Gaussian.Covariance(full), robust, 6)
    return gtsam.BetweenFactorPose3(as_key("key_a", key_a), as_key("key_b", key_b), motion, noise)


def odometry_factor_2d(
    key_a: int, key_b: int, delta: ArrayLike | gtsam.Pose2, covariance: ArrayLike, *, robust: Robust = None
) -> gtsam.BetweenFactorPose2:
    """2D odometry between two Pose2; arguments as in `odometry_factor`."""
    check_distinct(key_a=key_a, key_b=key_b)
    x, y, theta = _x_y_theta(delta)
    own = in_frame_of_end(theta, as_definite_covariance("covariance", covariance, 3))
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
    free_xy = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e8, 1e8, z]))  # infinity does not survive GTSAM's archives
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


def _sigmas(name: str, values: Sequence[float]) -> tuple[float, float, float]:
    z, roll, pitch = as_shape(name, values, (3,))
    return as_positive(name, z), as_positive(name, roll), as_positive(name, pitch)
