"""Least-squares registration: the motion that lays pairs of planes on each other, each as firm as it was measured."""

from __future__ import annotations

import numpy as np

from slam.geometry._rigid_kernels import expmap, logmap, product, solve_positive
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
    weights = np.linalg.inv(scatter)
    fitted, information = _solved(
        np.ascontiguousarray(motion), seen.frames[i], known.normals[j], known.distances[j], weights, expected
    )
    return fitted, np.linalg.inv(information)


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
def _solved(motion, frames, normals, distances, weights, expected):
    """The motion of least squares, shape (4, 4), and its information (6, 6) in the last step."""
    information, lower, told = np.empty((6, 6)), np.empty((6, 6)), np.empty(6)
    off, jacobian, moved = np.empty(3), np.zeros((3, 6)), motion
    for _ in range(_STEPS):
        before = logmap(moved)
        for a in range(6):
            told[a] = 0.0
            for b in range(6):
                information[a, b] = expected[a, b]
                told[a] -= expected[a, b] * before[b]
        for k in range(len(frames)):
            _write_off(moved, frames[k], normals[k], distances[k], off, jacobian)
            chi2 = 0.0
            for c in range(3):
                for d in range(3):
                    chi2 += off[c] * weights[k, c, d] * off[d]
            for a in range(6):
                for d in range(3):
                    weighted = 0.0
                    for c in range(3):
                        weighted += jacobian[c, a] * weights[k, c, d]
                    weighted /= 1.0 + chi2 / _DOUBTFUL
                    told[a] -= weighted * off[d]
                    for b in range(6):
                        information[a, b] += weighted * jacobian[d, b]
        solve_positive(information, told, lower)
        moved = product(moved, expmap(told))
    return moved, information


@inlined
def _write_off(motion, frame, normal, distance, off, jacobian):
    """How far a known plane lies from a seen one, height and two tilts (3,), and the derivative (3, 6).

    Args:
        motion: known_T_seen, shape (4, 4); the derivative is by its tangent on the right, GTSAM order.
        frame: of the plane seen, shape (4, 4).
        normal, distance: of the plane known, shape (3,) and number.
        off, jacobian: where to write.
    """
    turned = np.empty(3)
    off[0], off[1], off[2] = distance, 0.0, 0.0
    for a in range(3):
        turned[a] = normal[0] * motion[0, a] + normal[1] * motion[1, a] + normal[2] * motion[2, a]
        off[0] -= normal[a] * motion[a, 3] + turned[a] * frame[a, 3]
        off[1] += frame[a, 0] * turned[a]
        off[2] += frame[a, 1] * turned[a]
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        jacobian[0, a] = turned[b] * frame[c, 3] - turned[c] * frame[b, 3]
        jacobian[1, a] = frame[b, 0] * turned[c] - frame[c, 0] * turned[b]
        jacobian[2, a] = frame[b, 1] * turned[c] - frame[c, 1] * turned[b]
        jacobian[0, 3 + a] = -turned[a]
