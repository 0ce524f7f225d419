"""Kernels of constellation matching: walls moved by an uncertain pose, and the score of a pose.

A wall is a row (alpha, rho, var alpha, cov, var rho, first, last): its normal from the free side into the wall, signed
distance, covariance, and the coordinates of its ends along (-sin alpha, cos alpha). A pose is (x, y, theta) of b_T_a.
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner, njit

WALL = 7


@inner(cache=True)
def innovation(pose, covariance, wall, other):
    """How far `wall` (in a), moved by the pose, is from `other` (in b).

    Returns:
        error of (alpha, rho); its covariance entries 00, 01, 11; the overlap of the extents, m, negative for a gap; the
        variance of the move along the wall.
    """
    alpha = wall[0] + pose[2]
    c, s = np.cos(alpha), np.sin(alpha)
    lever = pose[1] * c - pose[0] * s
    turn = (other[0] - alpha + np.pi) % (2.0 * np.pi) - np.pi
    shift = other[1] - wall[1] - pose[0] * c - pose[1] * s
    pxx, pxy, pxt = covariance[0, 0], covariance[0, 1], covariance[0, 2]
    pyy, pyt, ptt = covariance[1, 1], covariance[1, 2], covariance[2, 2]
    v00 = wall[2] + ptt
    v01 = wall[3] + lever * wall[2] + c * pxt + s * pyt + lever * ptt
    v11 = wall[4] + 2.0 * lever * wall[3] + lever * lever * wall[2]
    v11 += c * c * pxx + 2.0 * c * s * pxy + s * s * pyy + 2.0 * lever * (c * pxt + s * pyt) + lever * lever * ptt
    overlap = min(wall[6] + lever, other[6]) - max(wall[5] + lever, other[5])
    along = s * s * pxx - 2.0 * c * s * pxy + c * c * pyy
    return turn, shift, v00 + other[2], v01 + other[3], v11 + other[4], overlap, along


@inner(cache=True)
def evidence(pose, covariance, wall, other, density, gate, min_overlap):
    """Log ratio of the shift's density if they are one wall to that of chance; -inf beyond the gate or apart."""
    turn, shift, v00, v01, v11, overlap, along = innovation(pose, covariance, wall, other)
    det = v00 * v11 - v01 * v01
    chi2 = (v11 * turn * turn - 2.0 * v01 * turn * shift + v00 * shift * shift) / det
    wanted = min_overlap * min(wall[6] - wall[5], other[6] - other[5])
    if not chi2 <= gate or overlap + 3.0 * np.sqrt(along) < wanted:
        return -np.inf
    rest = v11 - v01 * v01 / v00
    error = shift - v01 / v00 * turn
    return -0.5 * error * error / rest - 0.5 * np.log(2.0 * np.pi * rest) - np.log(density)


@njit(cache=True)
def score_table(pose, covariance, walls, others, densities, gate, min_overlap):
    """Evidence of every pair, (A, B)."""
    table = np.empty((walls.shape[0], others.shape[0]))
    for i in range(walls.shape[0]):
        for j in range(others.shape[0]):
            table[i, j] = evidence(pose, covariance, walls[i], others[j], densities[j], gate, min_overlap)
    return table


@njit(cache=True)
def fit_pose(pose, walls, others, prior):
    """Maximum-likelihood pose of matched walls, rows of `walls` to rows of `others`: (pose, covariance, chi2).

    `prior` (3, 3) is information about `pose`; it makes a pose solvable that the walls do not fix.
    """
    start, pose = pose, pose.copy()
    zero, covariance, normal = np.zeros((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    right, row, chi2 = np.empty(3), np.empty(3), np.inf
    for _ in range(6):
        chi2 = 0.0
        for a in range(3):
            right[a] = 0.0
            for b in range(3):
                normal[a, b] = prior[a, b]
                right[a] += prior[a, b] * (start[b] - pose[b])
        for k in range(walls.shape[0]):
            turn, shift, v00, v01, v11, _, _ = innovation(pose, zero, walls[k], others[k])
            alpha = walls[k, 0] + pose[2]
            row[0], row[1] = np.cos(alpha), np.sin(alpha)
            row[2] = pose[1] * row[0] - pose[0] * row[1]  # of the shift; the turn is one for one
            det = v00 * v11 - v01 * v01
            w00, w01, w11 = v11 / det, -v01 / det, v00 / det
            chi2 += w00 * turn * turn + 2.0 * w01 * turn * shift + w11 * shift * shift
            for a in range(3):
                by_turn, by_shift = (w00 if a == 2 else 0.0) + w01 * row[a], (w01 if a == 2 else 0.0) + w11 * row[a]
                right[a] += by_turn * turn + by_shift * shift
                normal[a, 2] += by_turn
                for b in range(3):
                    normal[a, b] += by_shift * row[b]
        invert_symmetric(normal, covariance)
        moved = 0.0
        for a in range(3):
            step = covariance[a, 0] * right[0] + covariance[a, 1] * right[1] + covariance[a, 2] * right[2]
            pose[a] += step
            moved += step * right[a]  # = step @ normal @ step
        if moved < 1e-8:
            break
    return pose, covariance, chi2


@inlined
def invert_symmetric(matrix, inverse):
    """Write the inverse of a symmetric 3x3 matrix, by cofactors."""
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        for d in range(3):
            e, f = (d + 1) % 3, (d + 2) % 3
            inverse[d, a] = matrix[b, e] * matrix[c, f] - matrix[b, f] * matrix[c, e]
    det = matrix[0, 0] * inverse[0, 0] + matrix[0, 1] * inverse[1, 0] + matrix[0, 2] * inverse[2, 0]
    for a in range(3):
        for b in range(3):
            inverse[a, b] /= det


@njit(cache=True)
def rank_hypotheses(walls, others, densities, pairs, max_hypotheses, prior, gate, angle_gate, min_sine, min_overlap):
    """Poses from two walls in different directions each, and the evidence all other walls give them.

    `pairs` (C, 2) are the correspondences, best first. Returns the two correspondences of each hypothesis (H, 2), its
    pose (H, 3) and its evidence (H,).
    """
    members = np.empty((max_hypotheses, 2), dtype=np.int64)
    poses = np.empty((max_hypotheses, 3))
    scores, start, count = np.empty(max_hypotheses), np.empty(3), 0
    chosen, targets = np.empty((2, WALL)), np.empty((2, WALL))
    for second in range(pairs.shape[0]):
        for first in range(second):
            i, j, k, m = pairs[first, 0], pairs[first, 1], pairs[second, 0], pairs[second, 1]
            a, b, c, d = walls[i], others[j], walls[k], others[m]
            twist = (d[0] - c[0] - b[0] + a[0] + np.pi) % (2.0 * np.pi) - np.pi
            if i == k or j == m or abs(np.sin(a[0] - c[0])) < min_sine:
                continue
            if twist * twist > angle_gate * (a[2] + b[2] + c[2] + d[2]):
                continue
            _write_motion(a, b, c, d, start)
            for n in range(WALL):
                chosen[0, n], chosen[1, n], targets[0, n], targets[1, n] = a[n], c[n], b[n], d[n]
            pose, covariance, _ = fit_pose(start, chosen, targets, prior)
            told = 0.0
            for n in range(2):
                told += evidence(pose, covariance, chosen[n], targets[n], 1.0, gate, min_overlap)
            if told == -np.inf:
                continue
            table = score_table(pose, covariance, walls, others, densities, gate, min_overlap)
            members[count, 0], members[count, 1] = first, second
            for n in range(3):
                poses[count, n] = pose[n]
            scores[count] = best_of_others(table, i, j, k, m)
            count += 1
            if count == max_hypotheses:
                return members, poses, scores
    return members[:count], poses[:count], scores[:count]


@inlined
def _write_motion(wall, other, second, second_other, pose):
    """Write the pose that lays one wall on another, and a second one of another direction on its other."""
    pose[2] = (other[0] - wall[0] + np.pi) % (2.0 * np.pi) - np.pi
    sine = np.sin(second_other[0] - other[0])
    p, q = other[1] - wall[1], second_other[1] - second[1]
    pose[0] = (p * np.sin(second_other[0]) - q * np.sin(other[0])) / sine
    pose[1] = (q * np.cos(other[0]) - p * np.cos(second_other[0])) / sine


@inlined
def best_of_others(table, i, j, k, m):
    """Sum of the best evidence of every wall but i and k, with walls other than j and m, where it is for the pose."""
    total = 0.0
    for row in range(table.shape[0]):
        best = 0.0
        for column in range(table.shape[1]):
            if row != i and row != k and column != j and column != m:
                best = max(best, table[row, column])
        total += best
    return total
