"""Chains of poses driven by wheels with errors of calibration, and seen now and then: graphs of known truth."""

from dataclasses import dataclass

import gtsam
import numpy as np

from factors import pose_prior
from slam.backend.estimator import Backend, pose_symbol
from slam.config import BackendConfig
from slam.frontend.odometry import Motion, planar_delta
from slam.geometry.frames import planar_transform
from slam.map.sparsification import MeasuredStep
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray

#: A rig that states no errors of calibration.
NOISE = OdometryNoise(z_sigma_m=1e-3, pitch_sigma_rad=1e-3, roll_sigma_rad=1e-3)
#: Standard deviations of what is seen of a pose: where it is, m, and how it is turned, rad.
_SEEN_M, _SEEN_RAD = 0.02, 0.01


@dataclass(frozen=True, eq=False)
class Chain:
    """A graph, and the truth."""

    backend: Backend
    steps: list[MeasuredStep]  # the odometry in it
    true: FloatArray  # world poses (N, 4, 4)


def chain(
    rng: np.random.Generator, errors: FloatArray, *, n_poses: int = 60, seen_every: int = 10, until: int | None = None
) -> Chain:
    """Half a metre a step, turning; every so many poses are seen, none from one on.

    `errors` are the scale and curvature that take measured motions to true ones.
    """
    backend, motions, indices, true = Backend(BackendConfig()), [], [], [np.eye(4)]
    factors, values, at = [], gtsam.Values(), np.eye(4)
    for k in range(n_poses):
        if k:
            measured = np.array((0.5, 0.0, rng.normal(0.0, 0.1)))
            response, random = NOISE.response([measured]), NOISE.covariance(measured)
            moved = measured + response @ errors + np.linalg.cholesky(random) @ rng.standard_normal(3)
            true.append(true[-1] @ planar_transform(*moved))
            motion = Motion(planar_transform(*measured), random, (1e-3,) * 3, response, NOISE.calibration_sigmas)
            motions.append((motion, len(indices) + len(factors)))
            factors += motion.factors(pose_symbol(k - 1), pose_symbol(k))[:1]
            at = at @ motion.a_T_b
        if k % seen_every == 0 and (until is None or k < until):
            factors.append(seen(rng, k, true[-1], exact=k == 0))
        values.insert(pose_symbol(k), gtsam.Pose3(at))
        if k % seen_every == 0 or k == n_poses - 1:
            indices += backend.update(factors, values)
            factors, values, at = [], gtsam.Values(), backend.pose(pose_symbol(k))
    backend.settle(10)
    steps = [MeasuredStep(k, k + 1, motion, indices[place]) for k, (motion, place) in enumerate(motions)]
    return Chain(backend, steps, np.array(true))


def seen(rng: np.random.Generator, k: int, true: FloatArray, *, exact: bool = False) -> gtsam.NonlinearFactor:
    """A look that tells a pose, world_T_body (4, 4), as well as looks do."""
    sigmas = np.array([_SEEN_M, _SEEN_M, 1e-2, _SEEN_RAD, 1e-2, 1e-2])
    off = np.zeros(6) if exact else sigmas * rng.standard_normal(6)
    x, y, heading = planar_delta(true) + off[[0, 1, 3]]
    return pose_prior(pose_symbol(k), planar_transform(x, y, heading), np.diag(sigmas**2))
