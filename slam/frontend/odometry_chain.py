"""Composition of motions: what odometry says between two keyframes that had others between them."""

from __future__ import annotations

import gtsam
import numpy as np

from factors._conventions import POSE3_TO_SP
from slam.frontend.odometry import Motion
from spplanes._check import FloatArray


def chained(first: Motion, second: Motion) -> Motion:
    """The motion from a to c by those from a to b and from b to c, both as measured, of one kind and one robot.

    To first order. Errors of calibration are the same in both; all others of one are independent of those of the other.
    """
    a_T_c = first.a_T_b @ second.a_T_b
    if not first.is_planar:
        carry = gtsam.Pose3(second.a_T_b).inverse().AdjointMap()[np.ix_(POSE3_TO_SP, POSE3_TO_SP)]
        covariance = carry @ first.covariance @ carry.T + second.covariance
        return Motion(a_T_c, covariance, first.out_of_plane_sigmas)
    turn, carry = np.eye(3), np.eye(3)
    turn[:2, :2] = first.a_T_b[:2, :2]
    moved = turn[:2, :2] @ second.a_T_b[:2, 3]
    carry[:2, 2] = -moved[1], moved[0]
    covariance = carry @ _own(first) @ carry.T + turn @ _own(second) @ turn.T
    response = None
    if first.response is not None and second.response is not None:
        response = carry @ first.response + turn @ second.response
        covariance = covariance + _shared(response, first.calibration_sigmas)
    out = _out_of_plane(first, second)
    return Motion(a_T_c, covariance, out, response, first.calibration_sigmas)


def _own(motion: Motion) -> FloatArray:
    """The part of a covariance that is of no other motion."""
    if motion.response is None:
        return motion.covariance
    return motion.covariance - _shared(motion.response, motion.calibration_sigmas)


def _shared(response: FloatArray, sigmas: tuple[float, float]) -> FloatArray:
    return response @ np.diag(np.square(sigmas)) @ response.T


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
