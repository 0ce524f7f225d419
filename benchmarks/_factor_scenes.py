"""Scenes of ``benchmarks.factors``."""

from __future__ import annotations

import gtsam
import numpy as np

from spplanes import Plane


def pose_key(i: int) -> int:
    """Key of pose i."""
    return gtsam.symbol("x", i)


def plane_key(j: int) -> int:
    """Key of plane j."""
    return gtsam.symbol("l", j)


def random_poses(rng: np.random.Generator, n: int) -> list[gtsam.Pose3]:
    """Poses within 5 m of the origin."""
    return [gtsam.Pose3(gtsam.Rot3.Rodrigues(rng.normal(size=3)), rng.uniform(-5, 5, 3)) for _ in range(n)]


def random_frames(rng: np.random.Generator, n: int, scale: float = 5.0) -> np.ndarray:
    """Plane frames (n, 4, 4) whose normals look at the origin."""
    frames = np.broadcast_to(np.eye(4), (n, 4, 4)).copy()
    for frame in frames:
        frame[:3, :3] = gtsam.Rot3.Rodrigues(2.0 * rng.normal(size=3)).matrix()
        frame[:3, 3] = rng.uniform(-scale, scale, 3)
        if frame[:3, 2] @ frame[:3, 3] > 0.0:
            frame[:3, 1:3] *= -1.0
    return frames


def helix(n_poses: int) -> list[gtsam.Pose3]:
    """Poses half a metre or so apart on a circle of 20 m that climbs slowly."""
    turns = 0.025 * np.arange(n_poses)
    places = np.column_stack([20.0 * np.sin(turns), 20.0 - 20.0 * np.cos(turns), 0.2 * turns])
    return [gtsam.Pose3(gtsam.Rot3.Yaw(turn), place) for turn, place in zip(turns, places, strict=True)]


def walk(sigmas: np.ndarray) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values, list[tuple[int, int, Plane]]]:
    """Odometry of 1,000 poses, their initial values, and 6,000 observations (pose, plane, Plane) of 200 planes."""
    rng, n_poses, n_planes, per_pose = np.random.default_rng(1), 1000, 200, 6
    truth, frames = helix(n_poses), random_frames(rng, n_planes)
    for j, frame in enumerate(frames):
        frame[:] = truth[j * n_poses // n_planes].matrix() @ frame
    graph, values, seen = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
    graph.addPriorPose3(pose_key(0), truth[0], gtsam.noiseModel.Isotropic.Sigma(6, 1e-4))
    step_noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.002)
    guess, covariance = truth[0], np.diag(sigmas) ** 2
    for i, pose in enumerate(truth):
        if i:
            step = truth[i - 1].between(pose).retract(0.002 * rng.normal(size=6))
            graph.push_back(gtsam.BetweenFactorPose3(pose_key(i - 1), pose_key(i), step, step_noise))
            guess = guess.compose(step)
        values.insert(pose_key(i), guess)
        first = min(i * n_planes // n_poses, n_planes - per_pose)
        for j in range(first, first + per_pose):
            z, theta, psi = sigmas * rng.normal(size=3)
            off = gtsam.Pose3(gtsam.Rot3.RzRyRx(psi, theta, 0.0), np.array([0.0, 0.0, z])).inverse().matrix()
            seen.append((i, j, Plane(pose.inverse().matrix() @ frames[j] @ off, covariance)))
    return graph, values, seen
