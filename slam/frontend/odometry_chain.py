"""Composition of motions: what odometry says between two keyframes that had others between them."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np

from factors._conventions import POSE3_TO_SP
from slam.frontend.odometry import Motion
from slam.frontend.wheel_calibration import shared_covariance
from spplanes._check import FloatArray


def chained(first: Motion, second: Motion) -> Motion:
    """The motion from a to c by those from a to b and from b to c, both as measured, of one kind and one robot.

    To first order. Errors of calibration are the same in both; all others of one are independent of those of the other.
    """
    a_T_c = first.a_T_b @ second.a_T_b
    turn, carry = np.eye(3), np.eye(3)
    turn[:2, :2] = first.a_T_b[:2, :2]
    moved = turn[:2, :2] @ second.a_T_b[:2, 3]
    carry[:2, 2] = -moved[1], moved[0]
    response, own = None, (first.covariance, second.covariance)
    if first.response is not None and second.response is not None:
        response, own = carry @ first.response + turn @ second.response, (_own(first), _own(second))
    if first.is_planar:
        covariance = carry @ own[0] @ carry.T + turn @ own[1] @ turn.T
        out = _out_of_plane(first, second)
    else:
        back = gtsam.Pose3(second.a_T_b).inverse().AdjointMap()[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
        covariance, out = back @ own[0] @ back.T + own[1], first.out_of_plane_sigmas
    whole = Motion(a_T_c, covariance, out, response, first.calibration_sigmas)
    if response is None:
        return whole
    return replace(whole, covariance=covariance + shared_covariance(whole, _stated(whole)))


def _own(motion: Motion) -> FloatArray:
    """The part of a covariance that is of no other motion."""
    return motion.covariance - shared_covariance(motion, _stated(motion))


def _stated(motion: Motion) -> FloatArray:
    return np.diag(np.square(motion.calibration_sigmas))


def _out_of_plane(first: Motion, second: Motion) -> tuple[float, float, float]:
    """Standard deviations (z, roll, pitch) of both: a tilt of the first lifts the end of the second."""
    lever = float(np.linalg.norm(second.a_T_b[:3, 3]))
    (z, *tilts), (other_z, *others) = first.out_of_plane_sigmas, second.out_of_plane_sigmas
    tilt = max(tilts)
    return (
        float(np.sqrt(z**2 + other_z**2 + (lever * tilt) ** 2)),
        float(np.hypot(tilt, others[0])),
        float(np.hypot(tilt, others[1])),
    )
