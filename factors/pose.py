"""Factors on whole poses, their covariance in the SPmodel's order."""

from __future__ import annotations

import gtsam
import numpy as np
from numpy.typing import ArrayLike

from factors._check import as_definite_covariance, as_key, check_distinct
from factors._conventions import SP_TO_POSE3
from factors.robust import Robust, with_robust
from spplanes._check import as_positive, as_shape, as_transform

_UP = np.array((0.0, 0.0, 1.0))


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
    return gtsam.AttitudeFactorPose3(as_key("pose_key", pose_key), gtsam.Unit3(_UP), noise, gtsam.Unit3(up))


def _noise(covariance: ArrayLike, robust: Robust) -> gtsam.noiseModel.Base:
    full = as_definite_covariance("covariance", covariance, 6)
    gaussian = gtsam.noiseModel.Gaussian.Covariance(full[SP_TO_POSE3[:, None], SP_TO_POSE3])
    return with_robust(gaussian, robust, 6)
