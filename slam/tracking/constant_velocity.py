"""Constant velocity: motion that nobody measured, with wide stated noise."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.config import CoastingConfig
from slam.frontend.odometry import Motion
from spplanes._check import FloatArray


def coast(
    a_T_b: FloatArray | None,
    before_s: float,
    ahead_s: float,
    rules: CoastingConfig,
    covariance: FloatArray | None = None,
) -> Motion:
    """The motion of the next `ahead_s` seconds by constant velocity.

    Args:
        a_T_b: Motion of the `before_s` seconds before, shape (4, 4); None: none is known, the body stands.
        before_s, ahead_s: How long that one took and this one takes, s.
        rules: How far velocity may change.
        covariance: Of that motion, SP order along the axes of its end, shape (6, 6): the next errs as it does. None: it
            is known. Along what was seen of no motion for a while velocity is an assumption that grows old.

    Returns:
        A spatial motion, with covariance in SP order. Without a motion before, the speed itself is unknown; with one,
        its change: an acceleration that lasts for the whole step moves the body by its sigma times ahead^2.
    """
    if a_T_b is None or before_s <= 0.0:
        step = np.eye(4)
        sigmas = rules.speed_sigma_m_per_s * ahead_s, rules.turn_sigma_rad_per_s * ahead_s
    else:
        step = gtsam.Pose3.Expmap(gtsam.Pose3.Logmap(gtsam.Pose3(a_T_b)) * (ahead_s / before_s)).matrix()
        square = ahead_s**2
        sigmas = rules.acceleration_sigma_m_per_s2 * square, rules.turn_change_sigma_rad_per_s2 * square
    total = np.diag(np.repeat([max(sigmas[0], rules.floor_m) ** 2, max(sigmas[1], rules.floor_rad) ** 2], 3))
    if covariance is not None and before_s > 0.0:
        total = total + (ahead_s / before_s) ** 2 * covariance
    return Motion(step, total, (rules.floor_m, rules.floor_rad, rules.floor_rad))
