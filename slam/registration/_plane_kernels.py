"""Kernels of plane registration: rotations and translations scored by the planes that find a partner, and partners.

Whether two polygons come near each other takes a microsecond here, where a geometry engine takes fifty.
"""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner, njit

#: Motions that a rotation gives at most.
BEST = 3


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
def unlike(rotations, trace, most):
    """Numbers of the first so many of rotations (K, 3, 3) none of which, turned back by one before, has that trace."""
    chosen, count = np.empty(most, np.int64), 0
    for k in range(len(rotations)):
        if count == most:
            break
        alike = False
        for c in chosen[:count]:
            total = 0.0
            for a in range(3):
                for b in range(3):
                    total += rotations[k, a, b] * rotations[c, a, b]
            alike |= total >= trace
        if not alike:
            chosen[count] = k
            count += 1
    return chosen[:count]


@njit(cache=True)
def best_shifts(own, normals, offsets, weights, middles, reaches, strongest, distance, sigma, tail):
    """The BEST translations (K, 3) of all that three of the strongest pairs (S,) define, and the weight each finds.

    Of every pair (P,) the plane seen, ascending (`own`), the known normal, how far the plane has to move along it, from
    its middle to that of the known one, and how near these have to come for the two to meet, m; `weights` (N,) are of
    the planes seen. Two planes are one up to `distance`, the less the further apart, and no translation is within half
    of that of a better one. Each costs `tail` log(1 + chi2 / (2 tail)).
    """
    shifts, found, scores, count = np.empty((BEST, 3)), np.empty(BEST), np.empty(BEST), 0
    for k in range(BEST):
        scores[k] = -np.inf
    shift, left = np.empty(3), _weight_left(own, weights)
    for a in range(strongest.size):
        for b in range(a + 1, strongest.size):
            for c in range(b + 1, strongest.size):
                triple = strongest[a], strongest[b], strongest[c]
                _shift_of(triple, normals, offsets, distance, sigma, shift)
                squared = shift[0] ** 2 + shift[1] ** 2 + shift[2] ** 2
                price = tail * np.log1p(0.5 * squared / sigma**2 / tail)
                needed = scores[-1] + price
                weight = _weight_found(own, normals, offsets, weights, middles, reaches, left, shift, distance, needed)
                if weight - price > scores[-1]:
                    count = _keep(shift, weight, weight - price, shifts, found, scores, count, 0.5 * distance)
    return shifts[:count], found[:count]


@inlined
def _keep(shift, weight, score, shifts, found, scores, count, apart):
    """Put a translation among the best, if none as near as `apart` is better, in place of those; how many are then."""
    kept = 0
    for k in range(count):
        square = (shifts[k, 0] - shift[0]) ** 2 + (shifts[k, 1] - shift[1]) ** 2 + (shifts[k, 2] - shift[2]) ** 2
        if square < apart**2 and scores[k] >= score:
            return count
        if square >= apart**2:
            _put(shifts, found, scores, kept, shifts[k], found[k], scores[k])
            kept += 1
    for k in range(kept, BEST):
        scores[k] = -np.inf
    k = min(kept, BEST - 1)
    while k > 0 and score > scores[k - 1]:
        _put(shifts, found, scores, k, shifts[k - 1], found[k - 1], scores[k - 1])
        k -= 1
    _put(shifts, found, scores, k, shift, weight, score)
    return min(kept + 1, BEST)


@inlined
def _put(shifts, found, scores, k, shift, weight, score):
    """Write a translation to place k."""
    for a in range(3):
        shifts[k, a] = shift[a]
    found[k], scores[k] = weight, score


@inlined
def _weight_left(own, weights):
    """Weight of the planes of this pair and of all after it, shape (P + 1,)."""
    left = np.zeros(own.size + 1)
    for p in range(own.size - 1, -1, -1):
        left[p] = left[p + 1] + (weights[own[p]] if p == own.size - 1 or own[p] != own[p + 1] else 0.0)
    return left


@inlined
def _weight_found(own, normals, offsets, weights, middles, reaches, left, shift, distance, needed):
    """Weight of the planes that a translation brings nearer than `distance` to a known one; -inf: less than needed."""
    weight, p = 0.0, 0
    while p < own.size and weight + left[p] > needed:
        plane, nearest = own[p], distance
        while p < own.size and own[p] == plane:
            along = normals[p, 0] * shift[0] + normals[p, 1] * shift[1] + normals[p, 2] * shift[2]
            off = abs(along - offsets[p])
            if off < nearest:
                square = 0.0
                for k in range(3):
                    square += (middles[p, k] - shift[k]) ** 2
                if square < reaches[p] ** 2:
                    nearest = off
            p += 1
        weight += weights[plane] * (1.0 - nearest / distance)
    return weight if p == own.size else -np.inf


@inlined
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
    shift[0] = (a * x + b * y + c * z) * scale
    shift[1] = (b * x + e * y + f * z) * scale
    shift[2] = (c * x + f * y + g * z) * scale


@njit(cache=True)
def partners(motion, mine, theirs, least_cosine, distance, gap):
    """(seen, known), (K, 2): for planes seen the known one nearest in offset that each is under a motion known_T_seen.

    Of either side frames (N, 4, 4), which have no outline (N,), and `Rings`. Two are one up to an angle, an offset
    (`distance`), and a gap between their outlines, m.
    """
    frames, bare, corners, ends, of = mine
    others, other_bare, other_corners, other_ends, other_of = theirs
    pairs, count = np.empty((len(frames), 2), np.int64), 0
    apart, frame = np.empty(len(others)), np.empty((3, 4))
    for i in range(len(frames)):
        for a in range(3):
            for b in range(4):
                frame[a, b] = motion[a, 3] if b == 3 else 0.0
                for c in range(3):
                    frame[a, b] += motion[a, c] * frames[i, c, b]
        _write_apart(frame, others, least_cosine, apart)
        while len(others):
            j = apart.argmin()
            if not apart[j] <= distance:
                break
            met = bare[i] or other_bare[j]
            if not met:
                rings, other_rings = ends[of[i] : of[i + 1] + 1], other_ends[other_of[j] : other_of[j + 1] + 1]
                flat = _flattened(corners, rings[0], rings[-1], frame, others[j])
                met = come_near(flat, rings, other_corners[other_rings[0] : other_rings[-1]], other_rings, gap)
            if met:
                pairs[count, 0], pairs[count, 1] = i, j
                count += 1
                break
            apart[j] = np.inf
    return pairs[:count]


@inlined
def _write_apart(frame, others, least_cosine, apart):
    """Write how far the offsets of other planes, in frames (M, 4, 4), are from that of one, (M,); inf: turned away."""
    offset = 0.0
    for a in range(3):
        offset += frame[a, 2] * frame[a, 3]
    for j in range(len(others)):
        cosine, known = 0.0, 0.0
        for a in range(3):
            cosine += frame[a, 2] * others[j, a, 2]
            known += others[j, a, 2] * others[j, a, 3]
        apart[j] = abs(offset - known) if cosine > least_cosine else np.inf


@inlined
def _flattened(corners, first, last, frame, other):
    """Corners in a frame from first to last, seen along the normal of another one (4, 4), in its (x, y)."""
    flat = np.empty((last - first, 2))
    for k in range(last - first):
        x, y = corners[first + k, 0], corners[first + k, 1]
        for b in range(2):
            total = 0.0
            for a in range(3):
                total += other[a, b] * (frame[a, 0] * x + frame[a, 1] * y + frame[a, 3] - other[a, 3])
            flat[k, b] = total
    return flat


@njit(cache=True)
def come_near(corners, ends, others, other_ends, gap):
    """Whether two polygons, even-odd, have points no farther apart than a gap.

    Of each its rings, corners (C, 2) and ends (R + 1,) as in `Rings`; ends count from the first on.
    """
    first, other_first = ends[0], other_ends[0]
    if not _boxes_come_near(corners, others, gap):
        return False
    for r in range(ends.size - 1):
        if _contains(others, other_ends, corners[ends[r] - first, 0], corners[ends[r] - first, 1]):
            return True
    for r in range(other_ends.size - 1):
        k = other_ends[r] - other_first
        if _contains(corners, ends, others[k, 0], others[k, 1]):
            return True
    for r in range(ends.size - 1):
        for k in range(ends[r] - first, ends[r + 1] - first - 1):
            for s in range(other_ends.size - 1):
                for m in range(other_ends[s] - other_first, other_ends[s + 1] - other_first - 1):
                    if _sides_come_near(corners, k, others, m, gap):
                        return True
    return False


@inlined
def _boxes_come_near(corners, others, gap):
    for axis in range(2):
        low, high, other_low, other_high = np.inf, -np.inf, np.inf, -np.inf
        for k in range(len(corners)):
            low, high = min(low, corners[k, axis]), max(high, corners[k, axis])
        for k in range(len(others)):
            other_low, other_high = min(other_low, others[k, axis]), max(other_high, others[k, axis])
        if not (low <= other_high + gap and other_low <= high + gap):
            return False
    return True


@inner(cache=True)
def _contains(corners, ends, x, y):
    """Whether a point lies within rings, even-odd."""
    inside = False
    for r in range(ends.size - 1):
        for k in range(ends[r] - ends[0], ends[r + 1] - ends[0] - 1):
            y0, y1 = corners[k, 1], corners[k + 1, 1]
            if (y0 > y) != (y1 > y):
                x0, x1 = corners[k, 0], corners[k + 1, 0]
                if x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
                    inside = not inside
    return inside


@inlined
def _sides_come_near(corners, k, others, m, gap):
    """Whether two segments, from each corner to the next, have points no farther apart than a gap."""
    for axis in range(2):
        a, b, c, d = corners[k, axis], corners[k + 1, axis], others[m, axis], others[m + 1, axis]
        if min(a, b) > max(c, d) + gap or min(c, d) > max(a, b) + gap:
            return False
    one = _side(corners, k, others, m) * _side(corners, k, others, m + 1)
    two = _side(others, m, corners, k) * _side(others, m, corners, k + 1)
    if one < 0.0 and two < 0.0:
        return True
    square = min(_square(others, m, corners, k), _square(others, m, corners, k + 1))
    return min(square, _square(corners, k, others, m), _square(corners, k, others, m + 1)) <= gap * gap


@inner(cache=True)
def _side(ends, a, points, p):
    """On which side of the line from end a to the next a point lies: the sign."""
    x, y = ends[a, 0], ends[a, 1]
    return (ends[a + 1, 0] - x) * (points[p, 1] - y) - (ends[a + 1, 1] - y) * (points[p, 0] - x)


@inner(cache=True)
def _square(ends, a, points, p):
    """Square of the distance of a point from the segment from end a to the next."""
    x, y = ends[a + 1, 0] - ends[a, 0], ends[a + 1, 1] - ends[a, 1]
    px, py = points[p, 0] - ends[a, 0], points[p, 1] - ends[a, 1]
    along, length = 0.0, x**2 + y**2
    if length > 0.0:
        along = min(max((px * x + py * y) / length, 0.0), 1.0)
    return (px - along * x) ** 2 + (py - along * y) ** 2
