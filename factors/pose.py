"""Factors on whole poses, their covariance in the SPmodel's order."""

from __future__ import annotations

import gtsam
from numpy.typing import ArrayLike

from factors._check import as_definite_covariance, as_key, check_distinct
from factors._conventions import SP_TO_POSE3, as_pose3
from factors.robust import Robust, with_robust
from spplanes._check import as_transform


def pose_prior(
    pose_key: int, world_T_body: gtsam.Pose3 | ArrayLike, covariance: ArrayLike, *, robust: Robust = None
) -> gtsam.PriorFactorPose3:
    """Prior on a Pose3: ``covariance`` (6, 6) of the SP differential (x, y, z, phi, theta, psi), on the right.

    ValueError: not a rigid transform, a singular covariance, a key that is no integer.
    """
    pose = as_pose3(as_transform("world_T_body", world_T_body))
    return gtsam.PriorFactorPose3(as_key("pose_key", pose_key), pose, _noise(covariance, robust))


def relative_pose_factor(
    key_a: int, key_b: int, a_T_b: gtsam.Pose3 | ArrayLike, covariance: ArrayLike, *, robust: Robust = None
) -> gtsam.BetweenFactorPose3:
    """Measured pose of b in the frame of a, Pose3 both: registration, loop closure, spatial odometry.

    ``covariance`` (6, 6) as in `pose_prior`, i.e. along the axes of b.
    ValueError: not a rigid transform, a singular covariance, keys that are no integers.
    """
    check_distinct(key_a=key_a, key_b=key_b)
    motion = as_pose3(as_transform("a_T_b", a_T_b))
    return gtsam.BetweenFactorPose3(as_key("key_a", key_a), as_key("key_b", key_b), motion, _noise(covariance, robust))


def _noise(covariance: ArrayLike, robust: Robust) -> gtsam.noiseModel.Base:
    full = as_definite_covariance("covariance", covariance, 6)
    gaussian = gtsam.noiseModel.Gaussian.Covariance(full[SP_TO_POSE3[:, None], SP_TO_POSE3])
    return with_robust(gaussian, robust, 6)
