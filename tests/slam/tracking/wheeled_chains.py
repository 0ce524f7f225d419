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
from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS, OdometryNoise
from spplanes._check import FloatArray

#: A rig that states no errors of calibration.
NOISE = OdometryNoise(z_sigma_m=1e-3, pitch_sigma_rad=1e-3, roll_sigma_rad=1e-3)
N_POSES = 60
#: Standard deviations of what is seen of a pose: where it is, m, and how it is turned, rad.
_SEEN_M, _SEEN_RAD = 0.02, 0.01


@dataclass(frozen=True, eq=False)
class Chain:
    """A graph, and the truth."""

    backend: Backend
    steps: list[MeasuredStep]  # the odometry in it
    true: FloatArray  # world poses (N, 4, 4)


def chain(
    rng: np.random.Generator,
    errors: FloatArray,
    *,
    seen_every: int = 10,
    until: int | None = None,
    stated: bool = False,
    noise: OdometryNoise = NOISE,
    along_m: float = _SEEN_M,
    turns_rad: float = 0.1,
) -> Chain:
    """Half a metre a step, turning; every so many poses are seen, none from one on.

    `errors` are the scale and curvature that take measured motions to true ones; `stated` is a rig that says how large
    they may be, `UNCALIBRATED_WHEELS` as of a robot nobody describes; `noise` is their random walk, and `along_m` how
    well what is seen tells x.
    """
    backend, motions, indices, true = Backend(BackendConfig()), [], [], [np.eye(4)]
    sigmas = UNCALIBRATED_WHEELS.calibration_sigmas if stated else NOISE.calibration_sigmas
    factors, values, at = [], gtsam.Values(), np.eye(4)
    for k in range(N_POSES):
        if k:
            moved = np.array((0.5, 0.0, rng.normal(0.0, turns_rad)))
            true.append(true[-1] @ planar_transform(*moved))
            measured = noisy = moved + np.linalg.cholesky(noise.covariance(moved)) @ rng.standard_normal(3)
            for _ in range(4):  # so that it is, corrected by the errors, what it is without them
                measured = noisy - noise.response([measured]) @ errors
            response, random = noise.response([measured]), noise.covariance(measured)
            wide = random + response @ np.diag(np.square(sigmas)) @ response.T
            motion = Motion(planar_transform(*measured), wide, (1e-3,) * 3, response, sigmas)
            motions.append((motion, len(indices) + len(factors)))
            factors += motion.factors(pose_symbol(k - 1), pose_symbol(k))[:1]
            at = at @ motion.a_T_b
        if k % seen_every == 0 and (until is None or k < until):
            factors.append(seen(rng, k, true[-1], exact=k == 0, along_m=along_m))
        values.insert(pose_symbol(k), gtsam.Pose3(at))
        if k % seen_every == 0 or k == N_POSES - 1:
            indices += backend.update(factors, values)
            factors, values, at = [], gtsam.Values(), backend.pose(pose_symbol(k))
    backend.settle(10)
    steps = [MeasuredStep(k, k + 1, motion, indices[place]) for k, (motion, place) in enumerate(motions)]
    return Chain(backend, steps, np.array(true))


def seen(
    rng: np.random.Generator, k: int, true: FloatArray, *, exact: bool = False, along_m: float = _SEEN_M
) -> gtsam.NonlinearFactor:
    """A look that tells a pose, world_T_body (4, 4), as well as looks do, and its x to `along_m`."""
    sigmas = np.array([_SEEN_M if exact else along_m, _SEEN_M, 1e-2, _SEEN_RAD, 1e-2, 1e-2])
    off = np.zeros(6) if exact else sigmas * rng.standard_normal(6)
    x, y, heading = planar_delta(true) + off[[0, 1, 3]]
    return pose_prior(pose_symbol(k), planar_transform(x, y, heading), np.diag(sigmas**2))
