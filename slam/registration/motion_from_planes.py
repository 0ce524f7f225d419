"""Least-squares registration: the motion that lays pairs of planes on each other, each as firm as it was measured."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from spplanes import Plane
from spplanes._check import FloatArray

#: What surfaces and sensors leave two views of a plane off each other, m, whatever their covariance says; over the
#: width of a plane it is a tilt.
_OFF_M = 0.01
#: A pair of this chi2 counts half: of three degrees of freedom, nine true ones in ten have less.
_DOUBTFUL = 6.0
_STEPS = 4


def fit_planes_on(
    motion: FloatArray, pairs: Sequence[tuple[Plane, Plane]], sigmas: tuple[float, float], loose: float = 1.0
) -> tuple[FloatArray, FloatArray] | None:
    """Least squares over pairs of planes, with what is expected where they are silent.

    What a pair is off is the distance of the seen plane's centre from the known plane, and two tilts about axes of the
    seen plane. Pairs far off hardly count: one wrong partner must not shift the place.

    Args:
        motion: known_T_seen to start from, shape (4, 4).
        pairs: (seen, known), either in its own frame.
        sigmas: standard deviations of the motion about none at all, m and rad, the same in all directions.
        loose: planes may be so many times further off than they usually are, for a start that is rough.

    Returns:
        The motion, and its covariance in the tangent on the right, GTSAM order (6, 6); None where fewer than three
        pairs, or all of one direction, leave it open.
    """
    if len(pairs) < 3 or np.linalg.svd(np.array([known.normal for _, known in pairs]))[1][1] < 0.3:
        return None
    expected = np.diag(1.0 / np.repeat([sigmas[1], sigmas[0]], 3) ** 2)
    frames = np.array([seen.frame for seen, _ in pairs])
    normals, distances = np.array([known.normal for _, known in pairs]), np.array([known.d for _, known in pairs])
    scatter = _scatter(motion, pairs, loose)
    information = expected
    for _ in range(_STEPS):
        off, jacobian = _off(motion, frames, normals, distances)
        weights = np.linalg.inv(scatter)
        chi2 = np.einsum("ki,kij,kj->k", off, weights, off)
        weights = weights / (1.0 + chi2 / _DOUBTFUL)[:, None, None]
        information = expected + np.einsum("kia,kij,kjb->ab", jacobian, weights, jacobian)
        told = expected @ gtsam.Pose3.Logmap(gtsam.Pose3(motion)) + np.einsum("kia,kij,kj->a", jacobian, weights, off)
        motion = motion @ gtsam.Pose3.Expmap(-np.linalg.solve(information, told)).matrix()
    return motion, np.linalg.inv(information).astype(np.float64)


def _scatter(motion: FloatArray, pairs: Sequence[tuple[Plane, Plane]], loose: float) -> FloatArray:
    """Covariances (K, 3, 3) of what pairs are off: as measured, and as planes of their size and distance may be."""
    flip = np.array([1.0, 1.0, -1.0])
    measured = np.array([seen.covariance for seen, _ in pairs]) * np.outer(flip, flip)
    widths = np.array([[_width(plane) for plane in pair] for pair in pairs])
    apart = np.array([np.linalg.norm(motion[:3, :3] @ a.centre + motion[:3, 3] - b.centre) for a, b in pairs])
    tilts = (loose * _OFF_M) ** 2 / widths**2
    extra = np.zeros_like(measured)
    extra[:, 0, 0] = (loose * _OFF_M) ** 2 + tilts[:, 1] * apart**2
    extra[:, 1, 1] = extra[:, 2, 2] = tilts.sum(axis=1)
    return measured + extra


def _width(plane: Plane) -> float:
    return 1.0 if plane.outline is None else max(float(np.sqrt(plane.outline.area)), 0.1)


def _off(
    motion: FloatArray, frames: FloatArray, normals: FloatArray, distances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far known planes (K,) lie from seen ones, height and two tilts (K, 3), and the derivative (K, 3, 6)."""
    turned, centres = normals @ motion[:3, :3], frames[:, :3, 3]
    heights = distances - normals @ motion[:3, 3] - np.einsum("ki,ki->k", turned, centres)
    tilts = np.einsum("kia,ki->ka", frames[:, :3, :2], turned)
    jacobian = np.zeros((len(frames), 3, 6))
    jacobian[:, 0, :3], jacobian[:, 0, 3:] = -np.cross(centres, turned), -turned
    jacobian[:, 1, :3] = np.cross(frames[:, :3, 0], turned)
    jacobian[:, 2, :3] = np.cross(frames[:, :3, 1], turned)
    return np.column_stack((heights, tilts)), jacobian
