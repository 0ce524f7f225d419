"""Least-squares registration: the motion that lays pairs of planes on each other, each as firm as it was measured."""

from __future__ import annotations

import numpy as np

from slam.geometry._rigid_kernels import expmap, logmap
from slam.registration._plane_arrays import PlaneArrays
from spplanes._check import FloatArray
from spplanes._jit import inlined, njit

#: What surfaces and sensors leave two views of a plane off each other, m, whatever their covariance says; over the
#: width of a plane it is a tilt.
_OFF_M = 0.01
#: A pair of this chi2 counts half: of three degrees of freedom, nine true ones in ten have less.
_DOUBTFUL = 6.0
_STEPS = 4
#: Narrower planes tilt no more than such ones, m.
_NARROWEST_M = 0.1
#: Least second singular value of the known normals: below, all look one way.
_SECOND = 0.3


def fit_pairs_on(
    motion: FloatArray,
    seen: PlaneArrays,
    known: PlaneArrays,
    pairs: np.ndarray,
    sigmas: tuple[float, float],
    loose: float = 1.0,
) -> tuple[FloatArray, FloatArray] | None:
    """Least squares over pairs of planes, with what is expected where they are silent.

    What a pair is off is the distance of the seen plane's centre from the known plane, and two tilts about axes of the
    seen plane. Pairs far off hardly count: one wrong partner must not shift the place.

    Args:
        motion: known_T_seen to start from, shape (4, 4).
        seen, known: planes, either in their own frame.
        pairs: (seen, known), their indices, shape (K, 2).
        sigmas: standard deviations of the motion about none at all, m and rad, the same in all directions.
        loose: planes may be so many times further off than they usually are, for a start that is rough.

    Returns:
        The motion, and its covariance in the tangent on the right, GTSAM order (6, 6); None where fewer than three
        pairs, or all of one direction, leave it open.
    """
    i, j = pairs.T
    if len(pairs) < 3 or np.linalg.eigvalsh(known.normals[j].T @ known.normals[j])[1] < _SECOND**2:
        return None
    apart = np.linalg.norm(seen.middles[i] @ motion[:3, :3].T + motion[:3, 3] - known.middles[j], axis=1)
    scatter = _scatter(seen.covariances[i], _widths(seen)[i], _widths(known)[j], apart, loose * _OFF_M)
    expected = np.diag(1.0 / np.repeat([sigmas[1], sigmas[0]], 3) ** 2)
    return _solved(
        np.ascontiguousarray(motion), seen.frames[i], known.normals[j], known.distances[j], scatter, expected
    )


def _widths(planes: PlaneArrays) -> FloatArray:
    """How wide planes are, (N,), m: the root of their area; of one without an outline a metre."""
    return np.where(planes.bare, 1.0, np.maximum(planes.weights, _NARROWEST_M))


def _scatter(
    measured: FloatArray, widths: FloatArray, other_widths: FloatArray, apart: FloatArray, off_m: float
) -> FloatArray:
    """Covariances (K, 3, 3) of what pairs are off: as measured, and as planes of their size and distance may be."""
    flip = np.array([1.0, 1.0, -1.0])
    scatter = measured * np.outer(flip, flip)
    scatter[:, 0, 0] += off_m**2 + (off_m / other_widths * apart) ** 2
    for axis in (1, 2):
        scatter[:, axis, axis] += (off_m / widths) ** 2 + (off_m / other_widths) ** 2
    return scatter


@njit(cache=True)
def _solved(motion, frames, normals, distances, scatter, expected):
    """The motion of least squares, shape (4, 4), and its covariance (6, 6)."""
    weights, information = np.empty_like(scatter), expected.copy()
    for k in range(len(scatter)):
        weights[k] = np.linalg.inv(scatter[k])
    for _ in range(_STEPS):
        off, jacobian = _off(motion, frames, normals, distances)
        information, told = expected.copy(), expected @ logmap(motion)
        for k in range(len(frames)):
            chi2 = 0.0
            for a in range(3):
                for b in range(3):
                    chi2 += off[k, a] * weights[k, a, b] * off[k, b]
            weighted = np.ascontiguousarray(jacobian[k].T) @ (weights[k] / (1.0 + chi2 / _DOUBTFUL))
            information += weighted @ jacobian[k]
            told += weighted @ off[k]
        motion = motion @ expmap(-np.linalg.solve(information, told))
    return motion, np.linalg.inv(information)


@inlined
def _off(motion, frames, normals, distances):
    """How far known planes lie from seen ones, height and two tilts (K, 3), and the derivative (K, 3, 6).

    Args:
        motion: known_T_seen, shape (4, 4); the derivative is by its tangent on the right, GTSAM order.
        frames: of the planes seen, shape (K, 4, 4).
        normals, distances: of the planes known, shapes (K, 3) and (K,).
    """
    off, jacobian, turned = np.zeros((len(frames), 3)), np.zeros((len(frames), 3, 6)), np.empty(3)
    for k in range(len(frames)):
        off[k, 0] = distances[k]
        for a in range(3):
            turned[a] = normals[k, 0] * motion[0, a] + normals[k, 1] * motion[1, a] + normals[k, 2] * motion[2, a]
            off[k, 0] -= normals[k, a] * motion[a, 3] + turned[a] * frames[k, a, 3]
            off[k, 1] += frames[k, a, 0] * turned[a]
            off[k, 2] += frames[k, a, 1] * turned[a]
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            jacobian[k, 0, a] = turned[b] * frames[k, c, 3] - turned[c] * frames[k, b, 3]
            jacobian[k, 1, a] = frames[k, b, 0] * turned[c] - frames[k, c, 0] * turned[b]
            jacobian[k, 2, a] = frames[k, b, 1] * turned[c] - frames[k, c, 1] * turned[b]
            jacobian[k, 0, 3 + a] = -turned[a]
    return off, jacobian
