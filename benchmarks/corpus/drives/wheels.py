"""Odometry of random drives: as good as the rig says, worse, biased, not described, absent, standing still or stops."""

from collections.abc import Callable
from itertools import accumulate

import numpy as np

from slam.sensors.wheel_noise import UNCALIBRATED_WHEELS, OdometryNoise
from slam.simulation.record import drifting_odometry
from slam.simulation.robots import ON_LEVEL_FLOOR, pose_matrices
from spplanes._check import FloatArray

#: What the rig says of a robot that also measures its attitude: from one keyframe to the next.
ON_RAMPS = OdometryNoise(z_sigma_m=0.005, pitch_sigma_rad=0.003, roll_sigma_rad=0.003)
#: Error of pitch and roll of every reading, rad.
_ATTITUDE_RAD = 0.002
#: Bias: share by which a wheel is larger than it should be, and drift of the heading, rad/m.
_SCALE, _DRIFT_RAD_PER_M = 0.03, 0.02
#: Standard deviations of `OdometryNoise` that are of its random walk.
_WALK = [name for name in OdometryNoise.model_fields if "_per_sqrt_" in name]

Odometry = Callable[[FloatArray, OdometryNoise, np.random.Generator], FloatArray]


def good(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """odom_T_body (N, 4, 4) of true poses (N, 4, 4) as the noise model of the rig has it."""
    planar = np.column_stack([poses[:, :2, 3], np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))])
    if not (poses[:, 2, 2] < 1.0).any():
        return pose_matrices(drifting_odometry(planar, noise, rng))
    return _over_ramps(poses, noise, rng)


def worse(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """Three times as noisy as the rig says."""
    return good(poses, noise.model_copy(update={name: 3.0 * getattr(noise, name) for name in _WALK}), rng)


def biased(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """Ways 3 % wrong and a heading that drifts, of which the rig says nothing."""
    return _erring(poses, rng.choice([-1.0, 1.0], 2) * (_SCALE, _DRIFT_RAD_PER_M), noise, rng)


def undescribed(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """Errors of calibration as large as those of wheels that nobody describes; all else is the noise."""
    return _erring(poses, rng.standard_normal(2) * UNCALIBRATED_WHEELS.calibration_sigmas, noise, rng)


def _erring(poses: FloatArray, errors: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """Ways wrong by a share, and a heading that drifts by so much a metre, shape (2,)."""
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    turns = errors[1] * np.linalg.norm(steps[:, :3, 3], axis=1)
    steps[:, :2, 3] *= 1.0 + errors[0]
    steps[:, :3, :3] = pose_matrices(np.column_stack([0.0 * turns, 0.0 * turns, turns]))[:, :3, :3] @ steps[:, :3, :3]
    noise = noise.model_copy(update={"scale_sigma": 0.0, "curvature_sigma_rad_per_m": 0.0})
    return good(_chained(poses[0], steps), noise, rng)


def still(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """The identity, while the robot drives."""
    return np.tile(np.eye(4), (len(poses), 1, 1))


def stops(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """As the rig says, but for a fifth of the drive, somewhere in its middle, when the wheels tell of no motion."""
    whole = good(poses, noise, rng)
    steps, first = np.linalg.inv(whole[:-1]) @ whole[1:], int(rng.uniform(0.2, 0.6) * len(poses))
    steps[first : first + len(poses) // 5] = np.eye(4)
    return _chained(whole[0], steps)


#: Kinds of odometry; None: there is none.
ODOMETRIES: dict[str, Odometry | None] = {
    "good": good,
    "worse3": worse,
    "biased": biased,
    "undescribed": undescribed,
    "absent": None,
    "still": still,
    "stops": stops,
}


def stated_noise(odometry: str, *, level: bool) -> OdometryNoise:
    """What the rig says of wheels of a kind, on one floor or over ramps."""
    stated = ON_LEVEL_FLOOR if level else ON_RAMPS
    if odometry != "undescribed":
        return stated
    out_of_plane = {name: getattr(stated, name) for name in ("z_sigma_m", "pitch_sigma_rad", "roll_sigma_rad")}
    return UNCALIBRATED_WHEELS.model_copy(update=out_of_plane)


def _over_ramps(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """Wheels, and an attitude sensor for pitch and roll: steps in the plane of the robot err as wheels do."""
    steps = np.linalg.inv(poses[:-1]) @ poses[1:]
    planar = np.column_stack([steps[:, :2, 3], np.arctan2(steps[:, 1, 0], steps[:, 0, 0])])
    roots = np.linalg.cholesky(noise.random_covariances(planar) + 1e-16 * np.eye(3))
    errors = roots @ rng.standard_normal((len(steps), 3, 1))
    wrong = pose_matrices(np.column_stack([np.zeros((len(steps), 2)), errors[:, 2, 0]]))[:, :3, :3]
    steps[:, :2, 3] += errors[:, :2, 0]
    steps[:, :3, :3] = wrong @ steps[:, :3, :3]
    chained, tilts = _chained(poses[0], steps), _ATTITUDE_RAD * rng.standard_normal((len(poses), 2))
    tilts[0] = 0.0
    for pose, (roll, pitch) in zip(chained, tilts, strict=True):
        pose[:3, :3] = pose[:3, :3] @ np.array([[1.0, 0.0, pitch], [0.0, 1.0, -roll], [-pitch, roll, 1.0]])
        u, _, vt = np.linalg.svd(pose[:3, :3])
        pose[:3, :3] = u @ vt
    return chained


def _chained(first: FloatArray, steps: FloatArray) -> FloatArray:
    """Poses (N + 1, 4, 4) from a first one and steps (N, 4, 4)."""
    return np.array(list(accumulate(steps, np.matmul, initial=first)))
