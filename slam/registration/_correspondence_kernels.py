"""Kernels of registration by surface elements: which may have another partner now, and how far each is from its own."""

from __future__ import annotations

import numpy as np

from slam.frontend.scan_surfaces import ON_EDGE, ON_NO_PLANE
from spplanes._jit import njit


@njit(cache=True)
def may_have_changed(points, asked, nearest, next_m, known, reach):
    """Which of points (N, 3) may have another of the elements (M, 9) nearest, within reach (N,), than where they were.

    Of there (`asked`) is known which was nearest, -1 for none, and how far all others were at least, (N,), m.
    """
    changed = np.empty(len(points), np.bool_)
    for k in range(len(points)):
        apart, moved = 0.0, 0.0
        for a in range(3):
            moved += (points[k, a] - asked[k, a]) ** 2
            if nearest[k] >= 0:
                apart += (points[k, a] - known[nearest[k], a]) ** 2
        far = reach[k] if nearest[k] < 0 else min(np.sqrt(apart), reach[k])
        changed[k] = far + np.sqrt(moved) > next_m[k]
    return changed


@njit(cache=True)
def point_to_plane(elements, motion, nearest, known, reach, least_cosine):
    """Elements (N, 9) whose nearest known one (M, 9) is a partner: of the same sort, within reach, and looking alike.

    Under a motion known_T_seen (4, 4); `nearest` (N,) is of the same sort, -1: none; edges look either way.

    Returns:
        Which elements (K,), how far off along their partners' directions (K,), m, the derivatives by the tangent of the
        motion on the right (K, 6), the variances by the noise of both (K,), m^2, and those of the partners' directions
        (K,), rad^2: of patches that were laid on their own few points, spread evenly over their widths.
    """
    index, off, variance = np.empty(len(elements), np.int64), np.empty(len(elements)), np.empty(len(elements))
    tilt = np.zeros(len(elements))
    jacobian, turned, count = np.empty((len(elements), 6)), np.empty(3), 0
    for k in range(len(elements)):
        if nearest[k] < 0:
            continue
        mine, other, square, along, cosine = elements[k], known[nearest[k]], 0.0, 0.0, 0.0
        for a in range(3):
            apart = motion[a, 3] - other[a]
            turned[a] = 0.0
            for b in range(3):
                apart += motion[a, b] * mine[b]
                turned[a] += motion[b, a] * other[3 + b]
            square += apart * apart
            along += apart * other[3 + a]
            cosine += turned[a] * mine[3 + a]
        if not (square < reach[k] ** 2 and (abs(cosine) if mine[7] == ON_EDGE else cosine) > least_cosine):
            continue
        for a in range(3):
            b, c = (a + 1) % 3, (a + 2) % 3
            jacobian[count, a], jacobian[count, 3 + a] = mine[b] * turned[c] - mine[c] * turned[b], turned[a]
        if other[7] == ON_NO_PLANE:
            tilt[count] = 12.0 * (other[6] / other[8]) ** 2
        index[count], off[count], variance[count] = k, along, mine[6] ** 2 + other[6] ** 2
        count += 1
    return index[:count], off[:count], jacobian[:count], variance[:count], tilt[:count]
