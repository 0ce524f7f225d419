"""Kernels of line extraction that tell round things, which break into chords, from walls."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner
from spplanes.lines._kernels import fit_sums, split_gate, sum_of

#: A share of the scatter that keeps circles of no curvature solvable; it bounds their radius, not that of pillars.
DAMPING = 1e-9


@inner(cache=True)
def solve_symmetric(matrix, x, y, z):
    """Solution p of [[a, b, c], [b, d, e], [c, e, f]] p = (x, y, z), `matrix` those six, and the determinant."""
    a, b, c, d, e, f = matrix
    m00, m01, m02 = d * f - e * e, c * e - b * f, b * e - c * d
    m11, m12, m22 = a * f - c * c, b * c - a * e, a * d - b * b
    det = a * m00 + b * m01 + c * m02
    return (
        (m00 * x + m01 * y + m02 * z) / det,
        (m01 * x + m11 * y + m12 * z) / det,
        (m02 * x + m12 * y + m22 * z) / det,
        det,
    )


@inlined
def circle_step(beams, low, high, x, y, radius):
    """One Gauss-Newton step for the circle nearest to beams low..high-1: (x, y, radius, chi2 before the step)."""
    cosines, sines, ranges, sigmas = beams.cosines, beams.sines, beams.ranges, beams.sigmas
    a = b = c = d = e = f = gx = gy = gr = chi2 = 0.0
    for k in range(low, high):
        cosine, sine = cosines[k], sines[k]
        dx, dy = ranges[k] * cosine - x, ranges[k] * sine - y
        distance = np.hypot(dx, dy) + 1e-12
        dx, dy = dx / distance, dy / distance
        incidence = max(abs(dx * cosine + dy * sine), 0.1)  # beyond where beams graze it the circle hides what there is
        weight = 1.0 / (incidence * sigmas[k]) ** 2
        error = distance - radius
        chi2 += weight * error * error
        a, b, c = a + weight * dx * dx, b + weight * dx * dy, c + weight * dx
        d, e, f = d + weight * dy * dy, e + weight * dy, f + weight
        gx, gy, gr = gx + weight * error * dx, gy + weight * error * dy, gr + weight * error
    sx, sy, sr, _ = solve_symmetric((a + DAMPING * f, b, c, d + DAMPING * f, e, f), gx, gy, gr)
    return x + sx, y + sy, radius + sr, chi2


@inlined
def algebraic_circle(beams, low, high):
    """Circle from the linear least squares of x^2 + y^2 = 2 a x + 2 b y + c about the middle beam: (x, y, radius)."""
    cosines, sines, ranges = beams.cosines, beams.sines, beams.ranges
    middle = (low + high) // 2
    ox, oy = ranges[middle] * cosines[middle], ranges[middle] * sines[middle]
    a = b = c = d = e = gx = gy = 0.0
    for k in range(low, high):
        x, y = ranges[k] * cosines[k] - ox, ranges[k] * sines[k] - oy
        square = x * x + y * y
        a, b, c, d, e = a + x * x, b + x * y, c + x, d + y * y, e + y
        gx, gy = gx + square * x, gy + square * y
    scatter = a + d
    damping = DAMPING * scatter
    px, py, pr, _ = solve_symmetric((a + damping, b, c, d + damping, e, float(high - low)), gx, gy, scatter)
    return ox + 0.5 * px, oy + 0.5 * py, np.sqrt(max(pr + 0.25 * (px * px + py * py), 1e-12))


@inlined
def bulges(beams, low, at, high):
    """True when beam `at` lies nearer to the sensor than the chord from beam low to beam high - 1."""
    bearings, ranges = beams.bearings, beams.ranges
    span = bearings[high - 1] - bearings[low]
    inverse = (
        np.sin(bearings[high - 1] - bearings[at]) / ranges[low]
        + np.sin(bearings[at] - bearings[low]) / ranges[high - 1]
    )
    return np.sin(span) > 0.0 and np.sin(span) / ranges[at] > inverse


@inlined
def bulging_arc(beams, low, high, chi2_lines):
    """Angle by which beams low..high-1 turn as an arc bulging to the sensor; 0 when lines of that chi2 fit better."""
    cosines, sines, ranges = beams.cosines, beams.sines, beams.ranges
    x, y, radius = algebraic_circle(beams, low, high)
    chi2, previous = np.inf, np.inf
    for _ in range(8):
        previous = chi2
        x, y, radius, chi2 = circle_step(beams, low, high, x, y, radius)
        if not 0.0 < radius < 1e3 or chi2 > 10.0 * chi2_lines:  # so bad a start does not become a circle
            return 0.0
        if abs(chi2 - previous) < 0.1:
            break
    if chi2 > chi2_lines or x * x + y * y <= ranges[(low + high) // 2] ** 2:
        return 0.0
    k = high - 1
    first = np.arctan2(ranges[low] * sines[low] - y, ranges[low] * cosines[low] - x)
    last = np.arctan2(ranges[k] * sines[k] - y, ranges[k] * cosines[k] - x)
    return abs((last - first + np.pi) % (2.0 * np.pi) - np.pi)


@inner(cache=True)
def find_round(beams, moments, breaks, starts, significance, min_arc):
    """Whether each beam (V,) is on an arc of at least `min_arc` that explains neighbouring pieces as lines do."""
    result = np.zeros(beams.ranges.size, dtype=np.bool_)
    n_pieces = starts.size - 1
    chi2 = np.empty(n_pieces)
    for i in range(n_pieces):
        chi2[i] = fit_sums(sum_of(moments, range(starts[i], starts[i + 1])))[2]
    for i in range(n_pieces - 1):
        lines = chi2[i]
        for j in range(i + 1, n_pieces):
            low, high = starts[i], starts[j + 1]
            if breaks[starts[j]] == 2 or high - low < 5 or not bulges(beams, low, starts[j], high):
                break
            lines += chi2[j]
            gate = lines + split_gate(high - low, significance)
            arc = bulging_arc(beams, low, high, gate)
            if arc == 0.0:
                break
            if arc > min_arc:
                for k in range(low, high):
                    result[k] = True
    return result
