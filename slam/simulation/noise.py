"""The errors of a simulated mission, drawn from the very models that rig.yaml states."""

from __future__ import annotations

import numpy as np

from slam.sensors.rig import LocalisationNoise, Sensor
from slam.sensors.wheel_noise import OdometryNoise
from spplanes._check import FloatArray


def noisy_ranges(ranges: FloatArray, sensor: Sensor, rng: np.random.Generator) -> FloatArray:
    """What the sensor reads of exact ranges: Gaussian noise, quantisation, NaN at and beyond its limits."""
    read = ranges + sensor.range_sigma_m * rng.standard_normal(ranges.shape)
    if sensor.quantisation_m > 0.0:
        read = sensor.quantisation_m * np.round(read / sensor.quantisation_m)
    return np.where((read > sensor.range_min_m) & (read < sensor.range_max_m), read, np.nan)


def drifting_odometry(poses: FloatArray, noise: OdometryNoise, rng: np.random.Generator) -> FloatArray:
    """Odometry's poses (K, 3) of true poses (K, 3), from the same start: a random walk on calibration errors."""
    steps = relative_motions(poses)
    scale, curvature = rng.standard_normal(2) * (noise.scale_sigma, noise.curvature_sigma_rad_per_m)
    way = np.hypot(steps[:, 0], steps[:, 1])
    factors = _square_roots(noise.random_covariances(steps))
    steps = steps + np.einsum("kij,kj->ki", factors, rng.standard_normal(steps.shape))
    steps = steps + np.column_stack([scale * steps[:, :2], curvature * way])
    heading = poses[0, 2] + np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    c, s = np.cos(heading[:-1]), np.sin(heading[:-1])
    moves = np.column_stack([c * steps[:, 0] - s * steps[:, 1], s * steps[:, 0] + c * steps[:, 1]])
    places = poses[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moves, axis=0)])
    return np.column_stack([places, heading])


def _square_roots(covariances: FloatArray) -> FloatArray:
    """Symmetric square roots (K, 3, 3); covariances may be singular, as of a robot that stands."""
    values, vectors = np.linalg.eigh(covariances)
    return vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :] @ vectors.transpose(0, 2, 1)


def relative_motions(poses: FloatArray) -> FloatArray:
    """Motions (K - 1, 3) between successive poses (K, 3), each in the frame of its first pose."""
    moves, heading = np.diff(poses, axis=0), poses[:-1, 2]
    c, s = np.cos(heading), np.sin(heading)
    return np.column_stack([c * moves[:, 0] + s * moves[:, 1], -s * moves[:, 0] + c * moves[:, 1], moves[:, 2]])


def localised_poses(
    poses: FloatArray, way_m: FloatArray, noise: LocalisationNoise, rng: np.random.Generator
) -> FloatArray:
    """Poses (K, 3) as a localisation gives them: three Ornstein-Uhlenbeck errors over the ways (K,) driven."""
    keep = np.exp(-np.diff(way_m) / noise.correlation_length_m)
    fresh = rng.standard_normal(poses.shape)
    errors = np.empty_like(fresh)
    errors[0] = fresh[0]
    for k in range(1, len(fresh)):
        errors[k] = keep[k - 1] * errors[k - 1] + np.sqrt(1.0 - keep[k - 1] ** 2) * fresh[k]
    return poses + errors * np.sqrt(np.diag(noise.covariance()))
