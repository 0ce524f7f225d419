"""Kernels of line extraction that tell round things, which break into chords, from walls."""

from __future__ import annotations

import numpy as np
from numba import njit

from spplanes._line_kernels import fit_sums, split_gate, sum_range

MAX_STEPS = 8
#: The noise of a beam that grazes the circle is taken at this cosine of its incidence: the circle hides what lies beyond.
MIN_COSINE = 0.1


@njit(cache=True, error_model="numpy")
def circle_step(bearings, ranges, sigmas, low, high, x, y, radius):
    """One Gauss-Newton step for the circle nearest to beams low..high-1: (x, y, radius, chi2 before the step)."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    row = np.empty(3)
    row[2] = 1.0
    chi2 = 0.0
    for k in range(low, high):
        c, s = np.cos(bearings[k]), np.sin(bearings[k])
        dx, dy = ranges[k] * c - x, ranges[k] * s - y
        distance = np.hypot(dx, dy) + 1e-12
        row[0], row[1] = dx / distance, dy / distance
        cosine = max(abs(row[0] * c + row[1] * s), MIN_COSINE)
        weight = 1.0 / (cosine * sigmas[k]) ** 2
        error = distance - radius
        chi2 += weight * error * error
        for i in range(3):
            right[i] += weight * row[i] * error
            for j in range(3):
                normal[i, j] += weight * row[i] * row[j]
    normal[0, 0] += 1e-9 * (normal[0, 0] + normal[1, 1])
    normal[1, 1] += 1e-9 * (normal[0, 0] + normal[1, 1])
    step = np.linalg.solve(normal, right)
    return x + step[0], y + step[1], radius + step[2], chi2


@njit(cache=True, error_model="numpy")
def algebraic_circle(bearings, ranges, sigmas, low, high):
    """Circle from the linear least squares of x^2 + y^2 = 2 a x + 2 b y + c about the middle beam: (x, y, radius)."""
    middle = (low + high) // 2
    ox, oy = ranges[middle] * np.cos(bearings[middle]), ranges[middle] * np.sin(bearings[middle])
    normal, right = np.zeros((3, 3)), np.zeros(3)
    row = np.ones(3)
    scale = 1e-12
    for k in range(low, high):
        row[0] = ranges[k] * np.cos(bearings[k]) - ox
        row[1] = ranges[k] * np.sin(bearings[k]) - oy
        square = row[0] * row[0] + row[1] * row[1]
        scale += square
        for i in range(3):
            right[i] += row[i] * square
            for j in range(3):
                normal[i, j] += row[i] * row[j]
    normal[0, 0] += 1e-9 * scale
    normal[1, 1] += 1e-9 * scale
    p = np.linalg.solve(normal, right)
    return ox + 0.5 * p[0], oy + 0.5 * p[1], np.sqrt(max(p[2] + 0.25 * (p[0] * p[0] + p[1] * p[1]), 1e-12))


@njit(cache=True, error_model="numpy")
def bulging_arc(bearings, ranges, sigmas, low, high, chi2_lines):
    """Angle by which beams low..high-1 turn as an arc that bulges to the sensor; 0 when lines of that chi2 fit better."""
    x, y, radius = algebraic_circle(bearings, ranges, sigmas, low, high)
    middle = (low + high) // 2
    if x * x + y * y <= ranges[middle] ** 2:
        return 0.0
    chi2 = np.inf
    for _ in range(MAX_STEPS):
        x, y, radius, chi2_new = circle_step(bearings, ranges, sigmas, low, high, x, y, radius)
        if not (radius > 0.0 and radius < 1e3):
            return 0.0
        if abs(chi2 - chi2_new) < 0.1:
            break
        chi2 = chi2_new
    if chi2_new > chi2_lines or x * x + y * y <= ranges[middle] ** 2:
        return 0.0
    first = np.arctan2(ranges[low] * np.sin(bearings[low]) - y, ranges[low] * np.cos(bearings[low]) - x)
    k = high - 1
    last = np.arctan2(ranges[k] * np.sin(bearings[k]) - y, ranges[k] * np.cos(bearings[k]) - x)
    return abs((last - first + np.pi) % (2.0 * np.pi) - np.pi)


@njit(cache=True, error_model="numpy")
def find_round(bearings, ranges, sigmas, moments, breaks, starts, significance, min_arc):
    """For each beam whether it lies on an arc of `min_arc` or more that explains neighbouring pieces as well as lines do."""
    result = np.zeros(bearings.size, dtype=np.bool_)
    n_pieces = starts.size - 1
    chi2 = np.empty(n_pieces)
    for i in range(n_pieces):
        chi2[i] = fit_sums(sum_range(moments, starts[i], starts[i + 1]))[2]
    for i in range(n_pieces - 1):
        lines = chi2[i]
        for j in range(i + 1, n_pieces):
            low, high = starts[i], starts[j + 1]
            if breaks[starts[j]] == 2 or high - low < 5:
                break
            lines += chi2[j]
            arc = bulging_arc(bearings, ranges, sigmas, low, high, lines + split_gate(high - low, significance))
            if arc == 0.0:
                break
            if arc > min_arc:
                result[low:high] = True
    return result
