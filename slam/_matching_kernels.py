"""Kernels of finding a motion by planes: rotations and translations scored by the planes that find a partner."""

from __future__ import annotations

import numpy as np
from numba import njit

#: Motions that a rotation gives at most.
BEST = 3


@njit(cache=True)
def near_rotations(frames, angles, others, other_angles, tolerance, least_trace):
    """Rotations from frames (A, 3, 3) to others (B, 3, 3) that enclose the same angle and turn no further than that.

    Returns:
        rotations (K, 3, 3) and their traces (K,), one frame after the other.
    """
    pairs, traces, count = np.empty((angles.size * other_angles.size, 2), np.int64), np.empty(16), 0
    for a in range(angles.size):
        for b in range(other_angles.size):
            if abs(angles[a] - other_angles[b]) < tolerance:
                trace = 0.0
                for i in range(3):
                    for j in range(3):
                        trace += others[b, i, j] * frames[a, i, j]
                if trace > least_trace:
                    if count == traces.size:
                        traces = np.concatenate((traces, np.empty(count)))
                    pairs[count, 0], pairs[count, 1], traces[count] = a, b, trace
                    count += 1
    rotations = np.empty((count, 3, 3))
    for k in range(count):
        a, b = pairs[k]
        for i in range(3):
            for j in range(3):
                rotations[k, i, j] = (
                    others[b, i, 0] * frames[a, j, 0]
                    + others[b, i, 1] * frames[a, j, 1]
                    + others[b, i, 2] * frames[a, j, 2]
                )
    return rotations, traces[:count]


@njit(cache=True)
def directions_found(rotations, normals, others, weights, least_cosine):
    """Weight of the normals (N, 3) that have one of the others (M, 3) beside them under rotations (K, 3, 3), (K,)."""
    found = np.zeros(rotations.shape[0])
    for k in range(rotations.shape[0]):
        R = rotations[k]
        for i in range(normals.shape[0]):
            x = R[0, 0] * normals[i, 0] + R[0, 1] * normals[i, 1] + R[0, 2] * normals[i, 2]
            y = R[1, 0] * normals[i, 0] + R[1, 1] * normals[i, 1] + R[1, 2] * normals[i, 2]
            z = R[2, 0] * normals[i, 0] + R[2, 1] * normals[i, 1] + R[2, 2] * normals[i, 2]
            for j in range(others.shape[0]):
                if x * others[j, 0] + y * others[j, 1] + z * others[j, 2] > least_cosine:
                    found[k] += weights[i]
                    break
    return found


@njit(cache=True)
def best_shifts(own, normals, offsets, weights, strongest, distance, sigma, tail):
    """The translations that most planes agree with, of all that three of the strongest pairs define.

    Args:
        own: seen plane of every pair, ascending, shape (P,).
        normals: known normal of every pair, shape (P, 3).
        offsets: how far the plane seen has to move along it, shape (P,), m.
        weights: of the planes seen, largest first, shape (N,).
        strongest: pairs that make translations, shape (S,).
        distance: two planes are one up to this, m.
        sigma: standard deviation of the translation, m; what it costs is `tail` log(1 + chi2 / (2 tail)).
        tail: see sigma.

    Returns:
        translations (K, 3), best first, of equal ones the first, and the weight each finds (K,), K <= BEST.
    """
    shifts, found, scores, count = np.zeros((BEST, 3)), np.zeros(BEST), np.full(BEST, -np.inf), 0
    shift, left = np.empty(3), _weight_left(own, weights)
    for a in range(strongest.size):
        for b in range(a + 1, strongest.size):
            for c in range(b + 1, strongest.size):
                triple = strongest[a], strongest[b], strongest[c]
                _shift_of(triple, normals, offsets, distance, sigma, shift)
                squared = shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2
                price = tail * np.log1p(0.5 * squared / sigma**2 / tail)
                weight = _weight_found(own, normals, offsets, weights, left, shift, distance, scores[-1] + price)
                if weight - price > scores[-1]:
                    k = BEST - 1
                    while k > 0 and weight - price > scores[k - 1]:
                        shifts[k], found[k], scores[k] = shifts[k - 1], found[k - 1], scores[k - 1]
                        k -= 1
                    shifts[k], found[k], scores[k] = shift, weight, weight - price
                    count = min(count + 1, BEST)
    return shifts[:count], found[:count]


@njit(cache=True)
def _weight_left(own, weights):
    """Weight of the planes of this pair and of all after it, shape (P + 1,)."""
    left = np.zeros(own.size + 1)
    for p in range(own.size - 1, -1, -1):
        left[p] = left[p + 1] + (weights[own[p]] if p == own.size - 1 or own[p] != own[p + 1] else 0.0)
    return left


@njit(cache=True)
def _weight_found(own, normals, offsets, weights, left, shift, distance, needed):
    """Weight of the planes that a translation brings to a known one, -inf where it cannot be more than is needed."""
    weight, p = 0.0, 0
    while p < own.size and weight + left[p] > needed:
        plane = own[p]
        while p < own.size and own[p] == plane:
            along = normals[p, 0] * shift[0] + normals[p, 1] * shift[1] + normals[p, 2] * shift[2]
            p += 1
            if abs(along - offsets[p - 1]) < distance:
                weight += weights[plane]
                while p < own.size and own[p] == plane:
                    p += 1
    return weight if p == own.size else -np.inf


@njit(cache=True)
def _shift_of(pairs, normals, offsets, distance, sigma, shift):
    """Translation of least squares by three pairs, errors of `distance`, and the expectation that it is none."""
    share = (distance / sigma) ** 2
    xx, yy, zz, xy, xz, yz, x, y, z = share, share, share, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for p in pairs:
        n0, n1, n2, d = normals[p, 0], normals[p, 1], normals[p, 2], offsets[p]
        xx, yy, zz, xy, xz, yz = xx + n0 * n0, yy + n1 * n1, zz + n2 * n2, xy + n0 * n1, xz + n0 * n2, yz + n1 * n2
        x, y, z = x + n0 * d, y + n1 * d, z + n2 * d
    a, b, c = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    scale = 1.0 / (xx * a + xy * b + xz * c)
    e, f, g = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    shift[0], shift[1], shift[2] = (
        (a * x + b * y + c * z) * scale,
        (b * x + e * y + f * z) * scale,
        ((c * x + f * y + g * z) * scale),
    )


@njit(cache=True)
def normal_equations(
    rotation, shift, normals, distances, others, other_distances, sizes, angle, distance, spread, told
):
    """Add the pairs of planes to the equations of a pose's tangent on the right (rotation, translation), in place.

    Errors are the differences of normals and of distances, of standard deviations a third of `angle` and `distance`;
    those far off weigh hardly at all.

    Args:
        rotation: known_R_seen, shape (3, 3).
        shift: known_t_seen, shape (3,), m.
        normals: of the planes seen, shape (P, 3).
        distances: of the planes seen, shape (P,), m.
        others: normals of the known ones, shape (P, 3).
        other_distances: of the known ones, shape (P,), m.
        sizes: weights, shape (P,).
        angle: rad.
        distance: m.
        spread: information, shape (6, 6).
        told: right side, shape (6,).
    """
    jacobian, residual, moved = np.zeros((4, 6)), np.empty(4), np.empty(3)
    precision = np.array([9.0 / angle**2, 9.0 / angle**2, 9.0 / angle**2, 9.0 / distance**2])
    for p in range(normals.shape[0]):
        n = normals[p]
        for i in range(3):
            R = rotation[i]
            moved[i] = R[0] * n[0] + R[1] * n[1] + R[2] * n[2]
            jacobian[i, 0] = R[2] * n[1] - R[1] * n[2]
            jacobian[i, 1] = R[0] * n[2] - R[2] * n[0]
            jacobian[i, 2] = R[1] * n[0] - R[0] * n[1]
        residual[3] = other_distances[p] - distances[p]
        for i in range(3):
            residual[i] = others[p, i] - moved[i]
            residual[3] -= moved[i] * shift[i]
            jacobian[3, i], jacobian[3, 3 + i] = 0.0, 0.0
            for k in range(3):
                jacobian[3, i] += shift[k] * jacobian[k, i]
                jacobian[3, 3 + i] += moved[k] * rotation[k, i]
        far = 0.0
        for i in range(4):
            far += residual[i] ** 2 * precision[i]
        for i in range(4):
            weight = precision[i] * sizes[p] / (1.0 + far)
            for a in range(6):
                told[a] += weight * jacobian[i, a] * residual[i]
                for b in range(6):
                    spread[a, b] += weight * jacobian[i, a] * jacobian[i, b]
