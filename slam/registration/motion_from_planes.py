"""Least-squares registration: the motion that lays pairs of planes on each other, each as firm as it was measured."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from slam.registration._plane_arrays import PlaneArrays
from spplanes._check import FloatArray

#: What surfaces and sensors leave two views of a plane off each other, m, whatever their covariance says; over the
#: width of a plane it is a tilt.
_OFF_M = 0.01
#: A pair of this chi2 counts half: of three degrees of freedom, nine true ones in ten have less.
_DOUBTFUL = 6.0


def fit_pairs(
    motions: Sequence[FloatArray],
    seen: PlaneArrays,
    known: PlaneArrays,
    pairs: Sequence[np.ndarray],
    sigmas: tuple[float, float],
    loose: float = 1.0,
) -> list[tuple[FloatArray, FloatArray] | None]:
    """Least squares over pairs of planes, with what is expected where they are silent, of many motions in one go.

    What a pair is off is the distance of the seen plane's centre from the known plane, and two tilts about axes of the
    seen plane. Pairs far off hardly count: one wrong partner must not shift the place.

    Args:
        motions: known_T_seen to start from, shape (4, 4) each.
        seen, known: planes, either in their own frame.
        pairs: of each motion (seen, known), their indices, shape (K, 2).
        sigmas: standard deviations of a motion about none at all, m and rad, the same in all directions.
        loose: planes may be so many times further off than they usually are, for a start that is rough.

    Returns:
        Each motion, and its covariance in the tangent on the right, GTSAM order (6, 6); None where fewer than three
        pairs, or all of one direction, leave it open.
    """
    told = [k for k, some in enumerate(pairs) if _fix_a_motion(known.normals[some[:, 1]])]
    if not told:
        return [None] * len(motions)
    start = np.array([motions[k] for k in told])
    fitted, information = _solved(start, seen, known, [pairs[k] for k in told], sigmas, loose)
    found = dict(zip(told, zip(fitted, np.linalg.inv(information), strict=True), strict=True))
    return [found.get(k) for k in range(len(motions))]


def _fix_a_motion(normals: FloatArray) -> bool:
    """Whether planes of these normals (K, 3) are three at least, and look more than one way."""
    return len(normals) >= 3 and bool(np.linalg.eigvalsh(normals.T @ normals)[1] >= 0.3**2)


def _solved(
    motions: FloatArray,
    seen: PlaneArrays,
    known: PlaneArrays,
    pairs: Sequence[np.ndarray],
    sigmas: tuple[float, float],
    loose: float,
) -> tuple[FloatArray, FloatArray]:
    """Motions of least squares, shape (M, 4, 4), and their information (M, 6, 6) in the last step."""
    counts = [len(some) for some in pairs]
    of, firsts = np.repeat(np.arange(len(counts)), counts), np.cumsum([0, *counts[:-1]])
    i, j = np.concatenate(pairs).T
    weights = np.linalg.inv(_scatter(motions[of], seen, known, i, j, loose * _OFF_M))
    expected, information = np.diag(np.repeat([sigmas[1], sigmas[0]], 3) ** -2.0), np.empty(0)
    for _ in range(4):
        off, jacobian = differences(motions[of], seen.frames[i], known.normals[j], known.distances[j])
        chi2 = np.einsum("kc,kcd,kd->k", off, weights, off)
        weighted = jacobian.transpose(0, 2, 1) @ weights / (1.0 + chi2 / _DOUBTFUL)[:, None, None]
        information = expected + np.add.reduceat(weighted @ jacobian, firsts)
        moved = np.array([gtsam.Pose3.Logmap(gtsam.Pose3(motion)) for motion in motions])
        told = np.add.reduceat((weighted @ off[:, :, None])[:, :, 0], firsts) + moved @ expected
        steps = np.linalg.solve(information, -told[:, :, None])[:, :, 0]
        motions = motions @ np.array([gtsam.Pose3.Expmap(step).matrix() for step in steps])
    return motions, information


def _scatter(
    motions: FloatArray, seen: PlaneArrays, known: PlaneArrays, i: np.ndarray, j: np.ndarray, off_m: float
) -> FloatArray:
    """Covariances (K, 3, 3) of what pairs are off: as measured, and as planes of their size and distance may be."""
    middles = np.einsum("kab,kb->ka", motions[:, :3, :3], seen.middles[i]) + motions[:, :3, 3]
    apart = np.linalg.norm(middles - known.middles[j], axis=1)
    widths, other_widths = _widths(seen)[i], _widths(known)[j]
    flip = np.array([1.0, 1.0, -1.0])
    scatter = seen.covariances[i] * np.outer(flip, flip)
    scatter[:, 0, 0] += off_m**2 + (off_m / other_widths * apart) ** 2
    for axis in (1, 2):
        scatter[:, axis, axis] += (off_m / widths) ** 2 + (off_m / other_widths) ** 2
    return scatter


def _widths(planes: PlaneArrays) -> FloatArray:
    """How wide planes are, (N,), m: the root of their area, at least 0.1; of one without an outline a metre."""
    return np.where(planes.bare, 1.0, np.maximum(planes.weights, 0.1))


def differences(
    motions: FloatArray, frames: FloatArray, normals: FloatArray, distances: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """How far known planes lie from seen ones, height and two tilts (K, 3), and the derivatives (K, 3, 6).

    Args:
        motions: known_T_seen of each pair, shape (K, 4, 4); derivatives are by its tangent on the right, GTSAM order.
        frames: of the planes seen, shape (K, 4, 4).
        normals, distances: of the planes known, shapes (K, 3) and (K,).
    """
    turned = np.einsum("kba,kb->ka", motions[:, :3, :3], normals)
    x_axis, y_axis, centre = frames[:, :3, 0], frames[:, :3, 1], frames[:, :3, 3]
    over = distances - np.einsum("ka,ka->k", normals, motions[:, :3, 3]) - np.einsum("ka,ka->k", turned, centre)
    off = np.stack((over, np.einsum("ka,ka->k", x_axis, turned), np.einsum("ka,ka->k", y_axis, turned)), axis=1)
    jacobian = np.zeros((len(off), 3, 6))
    jacobian[:, :, :3] = np.stack(
        (np.cross(turned, centre), np.cross(x_axis, turned), np.cross(y_axis, turned)), axis=1
    )
    jacobian[:, 0, 3:] = -turned
    return off, jacobian
