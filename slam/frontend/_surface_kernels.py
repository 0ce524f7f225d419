"""Kernels of surface elements: points gathered in cubes, jumps of range along a grid, points about a seed.

All sums go over the points in the order that they are given in, so the bits are the same on any machine.
"""

from __future__ import annotations

from math import frexp

import numpy as np

from spplanes._jit import inlined, njit


@njit(cache=True)
def numbered(keys):
    """Numbers of equal keys (N,), in order of the first of each; that first one (M,), and how many there are (M,).

    Keys below nought are left out: their number is -1.
    """
    size, shift = 16, np.uint64(60)  # 64 less the bits of a slot
    while size < 2 * keys.size:
        size *= 2
        shift -= np.uint64(1)
    mask, slots = np.uint64(size - 1), np.full(size, -1, np.int64)
    number, first, count = np.empty(keys.size, np.int64), np.empty(keys.size, np.int64), np.zeros(keys.size, np.int64)
    m = 0
    for k in range(keys.size):
        key = keys[k]
        if key < 0:
            number[k] = -1
            continue
        if k > 0 and key == keys[k - 1]:  # as most points that lie beside each other
            number[k] = number[k - 1]
            count[number[k]] += 1
            continue
        slot = (np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> shift  # Knuth's multiplier spreads keys
        while slots[slot] >= 0 and keys[first[slots[slot]]] != key:
            slot = (slot + np.uint64(1)) & mask
        if slots[slot] < 0:
            slots[slot] = m
            first[m] = k
            m += 1
        number[k] = slots[slot]
        count[number[k]] += 1
    return number, first[:m], count[:m]


@njit(cache=True)
def cube_keys(points, labels, share):
    """Keys of the cubes that points (N, 3), seen from the origin, lie in, (N,), ordered by width, label (N,) and place.

    A cube is as wide as this share of the range, rounded down to a power of two metres. -1: the label is below nought.
    """
    keys, most = np.empty(labels.size, np.int64), 0
    side = 2 * (int(2.0 / share) + 2)  # cubes to either side, no more than a range divided by half a width
    for k in range(labels.size):
        most = max(most, labels[k])
    for k in range(labels.size):
        if labels[k] < 0:
            keys[k] = -1
            continue
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        level = frexp(share * max(np.sqrt(x * x + y * y + z * z), 1e-3))[1] - 1
        width = 2.0**level
        key = (level + 1024) * (most + 1) + labels[k]  # never below nought
        key = key * side + int(np.floor(x / width)) + side // 2
        key = key * side + int(np.floor(y / width)) + side // 2
        keys[k] = key * side + int(np.floor(z / width)) + side // 2
    return keys


@njit(cache=True)
def moments(points, number, count):
    """Mean (M, 3) and scatter (M, 3, 3) of the points (N, 3) of every number, of which there are `count` (M,)."""
    mean, scatter = np.zeros((count.size, 3)), np.zeros((count.size, 3, 3))
    for k in range(number.size):
        m = number[k]
        if m >= 0:
            for a in range(3):
                mean[m, a] += points[k, a]
    for m in range(count.size):
        mean[m] /= count[m]
    for k in range(number.size):
        m = number[k]
        if m >= 0:
            for a in range(3):
                for b in range(a, 3):
                    scatter[m, a, b] += (points[k, a] - mean[m, a]) * (points[k, b] - mean[m, b])
    for m in range(count.size):
        for a in range(3):
            for b in range(a, 3):
                scatter[m, a, b] /= count[m]
                scatter[m, b, a] = scatter[m, a, b]
    return mean, scatter


@njit(cache=True)
def moments_about(seeds, points, reaches, least):
    """Mean (K, 3) and covariance (K, 3, 3) of the points within reach of each seed that has so many of them at least.

    Seeds (N, 3) reach so far, (N,); the first column of the points (M, 3) ascends.
    """
    starts = np.searchsorted(points[:, 0], seeds[:, 0] - reaches)
    mean, scatter, kept = np.zeros((len(seeds), 3)), np.zeros((len(seeds), 3, 3)), 0
    members = np.empty(len(points), np.int64)
    for s in range(len(seeds)):
        n, square, k = 0, reaches[s] * reaches[s], starts[s]
        while k < len(points) and points[k, 0] <= seeds[s, 0] + reaches[s]:
            x, y, z = points[k, 0] - seeds[s, 0], points[k, 1] - seeds[s, 1], points[k, 2] - seeds[s, 2]
            if x * x + y * y + z * z <= square:
                members[n] = k
                n += 1
            k += 1
        if n < least:
            continue
        for m in members[:n]:
            for a in range(3):
                mean[kept, a] += points[m, a]
        mean[kept] /= n
        for m in members[:n]:
            for a in range(3):
                for b in range(3):
                    scatter[kept, a, b] += (points[m, a] - mean[kept, a]) * (points[m, b] - mean[kept, b])
        scatter[kept] /= n - 1
        kept += 1
    return mean[:kept], scatter[:kept]


@njit(cache=True)
def jumps(points, ranges, labels, steps, inset):
    """Where ranges jump away along the lines of a grid: the next return is so much farther that nothing joins the two.

    That is by 0.1 m and 4 % of the range, and by four times the step of the surface before. Over 0.08 rad at most there
    is no return between the two sides of an edge: what casts a shadow hides it.

    Args:
        points: of the grid, flat, shape (N, 3).
        ranges: of the points, shape (N,); NaN: no return.
        labels: planes of the points, shape (N,); an edge within one plane is none.
        steps: (lines, beams, from line to line, from beam to beam, first): where the points of a line are.
        inset: edges are taken so many beams inside; none: in the middle of the last beam on the near side and the next.

    Returns:
        shape (K, 3).
    """
    lines, beams, line_step, beam_step, first = steps
    reach, count, found = max(inset, 1), 0, np.empty((lines * beams, 3))
    for line in range(lines):
        start, near = first + line * line_step, -1
        for beam in range(beams):
            there = start + beam * beam_step
            if not np.isfinite(ranges[there]):
                continue
            last, near = near, beam
            if last < reach:
                continue
            here, before = start + last * beam_step, start + (last - reach) * beam_step
            if labels[here] >= 0 and labels[here] == labels[there]:
                continue
            r, far = ranges[here], ranges[there]
            change = abs(r - ranges[before])  # how its surface goes on; NaN: nothing tells
            if not (change < 0.05 + 0.04 * r and far - r > max(0.1 + 0.04 * r, 4.0 * (change / reach) * (beam - last))):
                continue
            if not _cosine(points[here], points[there], r, far) > 0.9968017063026194:  # of 0.08 rad
                continue
            if inset == 0 and beam == last + 1:
                _between(points[here], points[there], r, far, found[count])
            else:
                for a in range(3):
                    found[count, a] = points[start + (last - inset) * beam_step, a]
            count += 1
    return found[:count]


@inlined
def _cosine(near, far, near_m, far_m):
    """Of the angle between the directions of two points at these ranges."""
    cosine = 0.0
    for a in range(3):
        cosine += (near[a] / near_m) * (far[a] / far_m)
    return cosine


@inlined
def _between(near, far, near_m, far_m, middle):
    """Write into `middle` (3,) the point in the direction between two others, at the range of the near one."""
    square = 0.0
    for a in range(3):
        middle[a] = near[a] / near_m + far[a] / far_m
        square += middle[a] ** 2
    for a in range(3):
        middle[a] *= near_m / np.sqrt(square)
