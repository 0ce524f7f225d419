"""Push-broom windows: relative poses and their joint covariance against sampled odometry."""

from itertools import pairwise

import numpy as np

from slam.frontend.measurement import window_poses
from slam.frontend.odometry import OdometryTrack, planar_delta, spatial_covariance
from slam.geometry.frames import inverse, planar_transform
from slam.sensors.log import OdometryReading
from slam.sensors.wheel_noise import OdometryNoise
from tests.statistics import assert_mean_in_band

NOISE = OdometryNoise()
PERIOD_NS = 100_000_000


def arc() -> np.ndarray:
    """Poses on a curved way, shape (13, 3)."""
    theta = np.linspace(0.2, 0.9, 13)
    return np.column_stack((2.0 * np.sin(theta) + 3.0, -2.0 * np.cos(theta) - 1.0, theta))


def track_of(poses: np.ndarray) -> OdometryTrack:
    return OdometryTrack([OdometryReading(i * PERIOD_NS, planar_transform(*p)) for i, p in enumerate(poses)], NOISE)


def resampled(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The way with every step disturbed by the noise model, shape (N, 4, 4)."""
    matrices = np.array([planar_transform(*pose) for pose in poses])
    result = [matrices[0]]
    for a, b in pairwise(matrices):
        delta = planar_delta(inverse(a) @ b)
        noisy = delta + np.linalg.cholesky(NOISE.covariance(delta)) @ rng.standard_normal(3)
        result.append(result[-1] @ planar_transform(*noisy))
    return np.array(result)


def test_joint_covariance_of_a_window_is_that_of_sampled_odometry():
    """NEES of the stacked errors (x, y, phi) of all scans, on both sides of the keyframe: wrong levers fail here."""
    rng, poses, keyframe = np.random.default_rng(5), arc(), 6
    others = [i for i in range(len(poses)) if i != keyframe]
    relative, joint = window_poses([i * PERIOD_NS for i in others], keyframe * PERIOD_NS, track_of(poses))
    way = np.array([planar_transform(*pose) for pose in poses])
    np.testing.assert_allclose(way[keyframe] @ relative, way[others], atol=1e-12)
    planar = np.array([6 * s + k for s in range(len(others)) for k in (0, 1, 3)])
    assert np.abs(np.delete(np.delete(joint, planar, axis=0), planar, axis=1)).max() == 0.0
    root, values = np.linalg.cholesky(joint[np.ix_(planar, planar)]), []
    for _ in range(400):
        noisy, errors = resampled(poses, rng), []
        for scan, index in enumerate(others):
            moved = inverse(noisy[keyframe]) @ noisy[index] @ inverse(relative[scan])
            errors += [moved[0, 3], moved[1, 3], np.arctan2(moved[1, 0], moved[0, 0])]
        values.append(float(np.sum(np.linalg.solve(root, np.array(errors)) ** 2)))
    assert_mean_in_band(np.array(values), len(planar))


def test_spatial_covariance_turns_into_the_axes_of_the_second_pose():
    """Drawn additively in a's axes, seen as a perturbation composed on the right of a_T_b."""
    rng, a_T_b, in_plane = np.random.default_rng(2), planar_transform(1.0, 0.3, 0.6), [0, 1, 3]
    planar = np.array([[4.0, 1.0, 0.3], [1.0, 2.0, -0.2], [0.3, -0.2, 0.5]]) * 1e-6
    covariance = spatial_covariance(planar, a_T_b, (0.001, 0.002, 0.003))
    root, values = np.linalg.cholesky(planar), []
    for _ in range(2000):
        drawn = planar_transform(*(planar_delta(a_T_b) + root @ rng.standard_normal(3)))
        error = planar_delta(inverse(a_T_b) @ drawn)
        values.append(error @ np.linalg.solve(covariance[np.ix_(in_plane, in_plane)], error))
    assert_mean_in_band(np.array(values), 3)
    np.testing.assert_allclose(np.diag(covariance)[[2, 4, 5]], [1e-6, 9e-6, 4e-6])


def test_poses_between_readings_are_the_same_whatever_else_is_asked_for():
    track, wanted = track_of(arc()), np.random.default_rng(1).integers(-PERIOD_NS, 14 * PERIOD_NS, 50)
    together = track.poses_at(wanted.tolist())
    alone = np.concatenate([track.poses_at([stamp]) for stamp in wanted.tolist()])
    np.testing.assert_allclose(together, alone, atol=1e-12)
    np.testing.assert_allclose(track.poses_at([-1, 0, 99 * PERIOD_NS])[[0, 2]], track.poses_at([0, 12 * PERIOD_NS]))
    assert track.poses_at([]).shape == (0, 4, 4)
