"""Scans and poses become points with covariances: beams, mounts, interpolation in time, shared pose errors.

The pose of a scan errs as a whole: its covariance is *shared* by the scan's points and travels beside them
(`RegisteredScans.pose_covariances`), never inside their own covariances, unless the paper's form is asked for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from spplanes._check import FloatArray, as_float_array, as_shape
from spplanes.noise import SensorModel
from spplanes.spmodel import skew


@dataclass(frozen=True, eq=False)
class RegisteredScans:
    """Scans of a 2D laser in one frame: what `segment_scans` and `PlaneMapper` take."""

    points: FloatArray
    """Shape (S, B, 3), m; NaN = no return."""
    covariances: FloatArray
    """Covariance of every point from its own beam, shape (S, B, 3, 3), m^2; NaN where there is no return."""
    viewpoints: FloatArray
    """Position of the sensor at every scan, shape (S, 3), m."""
    pose_covariances: FloatArray | None
    """Covariance of (x, y, z, phi, theta, psi) of every scan, world-side, shape (S, 6, 6); None: poses are exact."""
    scan_origins: FloatArray
    """Points about which those errors turn: the body's origin at every scan, shape (S, 3), m."""


def beam_directions(angles: ArrayLike) -> FloatArray:
    """Unit vectors of beams in the sensor's scan plane (x forward, y left), shape (B, 3), from bearings (B,), rad."""
    bearings = as_shape("angles", angles, (None,))
    return np.stack((np.cos(bearings), np.sin(bearings), np.zeros(len(bearings))), axis=1)


def interpolate_poses(stamps_ns: ArrayLike, poses: ArrayLike, at_ns: ArrayLike) -> FloatArray:
    """Poses (N, 4, 4) at times (N,) between given ones: positions linear in time, rotations by constant turn rate.

    Args:
        stamps_ns: times of the poses, ascending, shape (K,), ns.
        poses: world_T_body, shape (K, 4, 4).
        at_ns: times asked for, shape (N,), ns, within those of the poses.

    Raises:
        ValueError: poses out of time order, fewer than one, or a time outside of theirs.
    """
    stamps, wanted = np.asarray(stamps_ns, dtype=np.int64), np.asarray(at_ns, dtype=np.int64)
    known = as_shape("poses", poses, (None, 4, 4))
    if stamps.shape != (len(known),) or not len(known):
        raise ValueError(f"stamps_ns: expected one time per pose, shape ({len(known)},), got {stamps.shape}")
    if (np.diff(stamps) <= 0).any():
        where = int(np.argmax(np.diff(stamps) <= 0)) + 1
        raise ValueError(f"stamps_ns: expected ascending times, got {stamps[where]} after {stamps[where - 1]}")
    if wanted.size and (wanted.min() < stamps[0] or wanted.max() > stamps[-1]):
        got = f"{wanted.min()} to {wanted.max()}"
        raise ValueError(f"at_ns: expected times from {stamps[0]} to {stamps[-1]}, got {got}")
    if len(known) == 1:
        return np.repeat(known, len(wanted), axis=0)
    before = np.clip(np.searchsorted(stamps, wanted, side="right") - 1, 0, len(known) - 2)
    share = (wanted - stamps[before]) / (stamps[before + 1] - stamps[before])
    from scipy.spatial.transform import Rotation  # late: a slow import

    first, second = known[before], known[before + 1]
    start = Rotation.from_matrix(first[:, :3, :3])
    turn = (start.inv() * Rotation.from_matrix(second[:, :3, :3])).as_rotvec()
    result = first.copy()
    result[:, :3, :3] = (start * Rotation.from_rotvec(share[:, None] * turn)).as_matrix()
    result[:, :3, 3] += share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
    return result


def pose_covariance(x_y_theta: ArrayLike) -> FloatArray:
    """(6, 6) in (x, y, z, phi, theta, psi) of the covariance (3, 3) of a robot on the floor: x, y, heading."""
    result, rows = np.zeros((6, 6)), [0, 1, 3]
    result[np.ix_(rows, rows)] = as_shape("x_y_theta", x_y_theta, (3, 3))
    return result


def register_scans(
    ranges: ArrayLike,
    angles: ArrayLike,
    world_T_body: ArrayLike,
    model: SensorModel,
    *,
    body_T_sensor: ArrayLike | None = None,
    pose_covariances: ArrayLike | None = None,
    fold_pose: bool = False,
) -> RegisteredScans:
    """Points and covariances of S scans of a 2D laser.

    Args:
        ranges: shape (S, B), m; not finite, zero or negative = no return.
        angles: bearing of every beam, shape (B,), rad.
        world_T_body: pose of the body at every scan, shape (S, 4, 4).
        model: errors of the sensor; what all points of a scan share is added to the pose covariances.
        body_T_sensor: the mount, shape (4, 4); identity by default.
        pose_covariances: of (x, y, z, phi, theta, psi), world-side about the body's origin: (6, 6) or (S, 6, 6).
        fold_pose: the paper's form: put the pose error into each point's own covariance, as if it were independent,
            and return no pose covariances.
    """
    distances = as_shape("ranges", ranges, (None, None), finite=False)
    directions = beam_directions(angles)
    if distances.shape[1] != len(directions):
        raise ValueError(f"ranges: expected {len(directions)} beams a scan, one per angle, got {distances.shape[1]}")
    distances = np.where(np.isfinite(distances) & (distances > 0.0), distances, np.nan)
    poses = as_shape("world_T_body", world_T_body, (len(distances), 4, 4))
    mount = np.eye(4) if body_T_sensor is None else as_shape("body_T_sensor", body_T_sensor, (4, 4))
    sensors = poses @ mount
    rays = distances[..., None] * (directions @ sensors[:, :3, :3].transpose(0, 2, 1))
    viewpoints, origins = sensors[:, :3, 3].copy(), poses[:, :3, 3].copy()
    points = rays + viewpoints[:, None]
    covariances = model.covariances(points, viewpoints[:, None])
    shared = _shared(model, pose_covariances, len(distances), viewpoints - origins)
    if shared is not None and fold_pose:
        from spplanes.fitting._pose_error import shared_by_scan

        covariances = covariances + shared_by_scan(points, shared, origins).reshape(covariances.shape)
        shared = None
    return RegisteredScans(points, covariances, viewpoints, shared, origins)


def _shared(
    model: SensorModel, pose_covariances: ArrayLike | None, n_scans: int, levers: FloatArray
) -> FloatArray | None:
    """Pose covariance of every scan, the sensor's own shared error moved to the body's origin; None: nothing shared."""
    own = model.scan_covariance()
    if pose_covariances is None and not own.any():
        return None
    total = np.zeros((n_scans, 6, 6))
    if pose_covariances is not None:
        total += as_float_array("pose_covariances", pose_covariances)
    if own.any():
        moved = np.eye(6)
        for s, lever in enumerate(levers):
            moved[:3, 3:] = skew(lever)[:, ::-1]
            total[s] += moved @ own @ moved.T
    return total
