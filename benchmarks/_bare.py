"""Bare loops of the same arithmetic as the stages of `benchmarks.limits`, written by hand in one go over the data.

They take good input for granted where nothing is said of checks, and find out nothing: which points are on one plane,
where a line ends, when a fit has converged is known to them. What they leave out is said of each.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def copy(source: np.ndarray, target: np.ndarray) -> None:
    """One number after the other."""
    for k in range(source.size):
        target[k] = source[k]


@njit(cache=True, error_model="numpy")
def is_good(c: np.ndarray) -> bool:
    """Finite, symmetric, positive definite: nine numbers read, three pivots."""
    for i in range(3):
        for j in range(3):
            if not np.isfinite(c[i, j]):
                return False
    d = c[1, 1] - c[0, 1] * c[0, 1] / c[0, 0]
    e = c[1, 2] - c[0, 1] * c[0, 2] / c[0, 0]
    f = c[2, 2] - c[0, 2] * c[0, 2] / c[0, 0] - e * e / d
    return c[0, 1] == c[1, 0] and c[0, 2] == c[2, 0] and c[1, 2] == c[2, 1] and min(c[0, 0], d, f) > 0.0


@njit(cache=True, error_model="numpy")
def check(points: np.ndarray, covariances: np.ndarray) -> int:
    """Points and covariances that are no good."""
    bad = 0
    for k in range(len(points)):
        finite = np.isfinite(points[k, 0]) and np.isfinite(points[k, 1]) and np.isfinite(points[k, 2])
        bad += not (finite and is_good(covariances[k]))
    return bad


@njit(cache=True, error_model="numpy")
def start(points: np.ndarray, covariances: np.ndarray, sums: np.ndarray) -> None:
    """Weights by the trace, and weighted moments to second order."""
    w0 = sx = sy = sz = xx = xy = xz = yy = yz = zz = 0.0
    for k in range(len(points)):
        c, x, y, z = covariances[k], points[k, 0], points[k, 1], points[k, 2]
        w = 1.0 / (c[0, 0] + c[1, 1] + c[2, 2])
        w0, sx, sy, sz = w0 + w, sx + w * x, sy + w * y, sz + w * z
        xx, xy, xz = xx + w * x * x, xy + w * x * y, xz + w * x * z
        yy, yz, zz = yy + w * y * y, yz + w * y * z, zz + w * z * z
    sums[:10] = w0, sx, sy, sz, xx, xy, xz, yy, yz, zz


@njit(cache=True, error_model="numpy")
def step(points: np.ndarray, covariances: np.ndarray, frame: np.ndarray, sums: np.ndarray) -> None:
    """A Gauss-Newton step: gradient and information at foot points, moments, the noise along the plane."""
    x0, x1, x2 = frame[0, 0], frame[1, 0], frame[2, 0]
    y0, y1, y2 = frame[0, 1], frame[1, 1], frame[2, 1]
    n0, n1, n2 = frame[0, 2], frame[1, 2], frame[2, 2]
    g0 = g1 = g2 = h00 = h01 = h02 = h11 = h12 = h22 = sx = sy = xx = xy = yy = tx = txy = ty = chi2 = 0.0
    for k in range(len(points)):
        if np.isnan(points[k, 0]):
            continue
        c = covariances[k]
        c00, c01, c02, c11, c12, c22 = c[0, 0], c[0, 1], c[0, 2], c[1, 1], c[1, 2], c[2, 2]
        q0, q1, q2 = points[k, 0] - frame[0, 3], points[k, 1] - frame[1, 3], points[k, 2] - frame[2, 3]
        x, y, z = x0 * q0 + x1 * q1 + x2 * q2, y0 * q0 + y1 * q1 + y2 * q2, n0 * q0 + n1 * q1 + n2 * q2
        u0, u1, u2 = c00 * n0 + c01 * n1 + c02 * n2, c01 * n0 + c11 * n1 + c12 * n2, c02 * n0 + c12 * n1 + c22 * n2
        a0, a1, a2 = c00 * x0 + c01 * x1 + c02 * x2, c01 * x0 + c11 * x1 + c12 * x2, c02 * x0 + c12 * x1 + c22 * x2
        b0, b1, b2 = c00 * y0 + c01 * y1 + c02 * y2, c01 * y0 + c11 * y1 + c12 * y2, c02 * y0 + c12 * y1 + c22 * y2
        ux, uy = x0 * u0 + x1 * u1 + x2 * u2, y0 * u0 + y1 * u1 + y2 * u2
        w = 1.0 / (n0 * u0 + n1 * u1 + n2 * u2)
        fx, fy = x - ux * z * w, y - uy * z * w
        g0, g1, g2, chi2 = g0 + w * z, g1 + w * z * fx, g2 + w * z * fy, chi2 + z * z * w
        h00, h01, h02 = h00 + w, h01 + w * fx, h02 + w * fy
        h11, h12, h22 = h11 + w * fx * fx, h12 + w * fx * fy, h22 + w * fy * fy
        sx, sy, xx, xy, yy = sx + w * x, sy + w * y, xx + w * x * x, xy + w * x * y, yy + w * y * y
        tx += w * (x0 * a0 + x1 * a1 + x2 * a2 - ux * ux * w)
        txy += w * (y0 * a0 + y1 * a1 + y2 * a2 - ux * uy * w)
        ty += w * (y0 * b0 + y1 * b1 + y2 * b2 - uy * uy * w)
    sums[:9] = g0, g1, g2, h00, h01, h02, h11, h12, h22
    sums[9:18] = sx, sy, xx, xy, yy, tx, txy, ty, chi2


@njit(cache=True, error_model="numpy")
def spread(points: np.ndarray, covariances: np.ndarray, frame: np.ndarray, sums: np.ndarray) -> None:
    """The covariance of a plane fitted by the trace: six sums of rows times the covariance of a point times rows."""
    rows, local, s = np.empty((3, 3)), np.empty(3), np.zeros((3, 3))
    for k in range(len(points)):
        c = covariances[k]
        q0, q1, q2 = points[k, 0] - frame[0, 3], points[k, 1] - frame[1, 3], points[k, 2] - frame[2, 3]
        for i in range(3):
            local[i] = frame[0, i] * q0 + frame[1, i] * q1 + frame[2, i] * q2
        w = 1.0 / (c[0, 0] + c[1, 1] + c[2, 2]) ** 2
        for j in range(3):
            rows[0, j] = frame[j, 2]
            rows[1, j] = local[0] * frame[j, 2] + local[2] * frame[j, 0]
            rows[2, j] = local[1] * frame[j, 2] + local[2] * frame[j, 1]
        for i in range(3):
            v0 = c[0, 0] * rows[i, 0] + c[0, 1] * rows[i, 1] + c[0, 2] * rows[i, 2]
            v1 = c[0, 1] * rows[i, 0] + c[1, 1] * rows[i, 1] + c[1, 2] * rows[i, 2]
            v2 = c[0, 2] * rows[i, 0] + c[1, 2] * rows[i, 1] + c[2, 2] * rows[i, 2]
            for j in range(i + 1):
                s[i, j] += w * w * (rows[j, 0] * v0 + rows[j, 1] * v1 + rows[j, 2] * v2)
    sums[:9] = s.ravel()


@njit(cache=True, error_model="numpy")
def segmentation(
    points: np.ndarray,
    covariances: np.ndarray,
    eyes: np.ndarray,
    planes: np.ndarray,
    sums: np.ndarray,
    grid: np.ndarray,
) -> int:
    """What each point of a grid costs: its check, its depth and variance, two chi2 tests against neighbours, its share
    in the sums of a cell, its distance to two planes, and its cell in the raster of an outline.

    Left out: which cells grow into which region, everything done more than once for a point (borders, refining,
    joining), the outlines' contours. `sums` (S, B, 10) and `grid` (R, R) are written to.
    """
    n_scans, n_beams = points.shape[:2]
    before_r, before_v = np.full(n_beams, np.nan), np.full(n_beams, np.nan)
    kept = 0
    for s in range(n_scans):
        last_r = last_v = np.nan
        for b in range(n_beams):
            x, y, z = points[s, b, 0], points[s, b, 1], points[s, b, 2]
            c = covariances[s, b]
            if np.isnan(x) or not is_good(c):
                last_r = before_r[b] = np.nan
                continue
            dx, dy, dz = x - eyes[s, 0], y - eyes[s, 1], z - eyes[s, 2]
            r = np.sqrt(dx * dx + dy * dy + dz * dz)
            dx, dy, dz = dx / r, dy / r, dz / r
            v = dx * (c[0, 0] * dx + 2.0 * (c[0, 1] * dy + c[0, 2] * dz)) + dy * (c[1, 1] * dy + 2.0 * c[1, 2] * dz)
            v += dz * c[2, 2] * dz
            kept += (r - last_r) ** 2 < 9.0 * (v + last_v)
            kept += (r - before_r[b]) ** 2 < 9.0 * (v + before_v[b])
            last_r, last_v, before_r[b], before_v[b] = r, v, r, v
            w, row = 1.0 / v, sums[s // 4, b // 4]
            row[0], row[1], row[2], row[3] = row[0] + w, row[1] + w * x, row[2] + w * y, row[3] + w * z
            row[4], row[5], row[6] = row[4] + w * x * x, row[5] + w * x * y, row[6] + w * x * z
            row[7], row[8], row[9] = row[7] + w * y * y, row[8] + w * y * z, row[9] + w * z * z
            one = planes[0, 0] * x + planes[0, 1] * y + planes[0, 2] * z - planes[0, 3]
            other = planes[1, 0] * x + planes[1, 1] * y + planes[1, 2] * z - planes[1, 3]
            kept += one * one * w < other * other * w
            grid[int(abs(x) / 0.05) % len(grid), int(abs(y) / 0.05) % len(grid)] = True
    return kept


@njit(cache=True, error_model="numpy")
def lines(ranges: np.ndarray, angles: np.ndarray, sigma: float, cost: np.ndarray) -> float:
    """What each beam of a scan costs: cosine and sine of its bearing, sines of the two steps for the test of three
    neighbours, its share in six sums; twice (split, and boundaries moved) running sums from both ends with a fit and
    its chi2 at every beam; four steps of the fit by ranges; the sums that tell an arc.

    Left out: cutting more than once, circles, merging, ends.
    """
    n, total = ranges.size, 0.0
    moments, cosines, sines = np.empty((n, 6)), np.cos(angles), np.sin(angles)
    for k in range(n):
        c, s, r, i, j = cosines[k], sines[k], ranges[k], k - 1, (k + 1 if k + 1 < n else 0)
        left, middle = np.sin(angles[j] - angles[k]), np.sin(angles[j] - angles[i])
        error = left / ranges[i] + middle / r + left / ranges[j]
        total += error * error < 9.0 * (
            (left / ranges[i] ** 2) ** 2 + (middle / r**2) ** 2 + (left / ranges[j] ** 2) ** 2
        )
        scale = (r / sigma) ** 2
        moments[k, 0], moments[k, 1], moments[k, 2] = (
            scale * r * r * c * c,
            scale * r * r * c * s,
            scale * r * r * s * s,
        )
        moments[k, 3], moments[k, 4], moments[k, 5] = scale * r * c, scale * r * s, scale
    for _ in range(2):
        for forward in (True, False):
            cc = cs = ss = cq = sq = qq = 0.0
            for at in range(n):
                k = at if forward else n - 1 - at
                cc, cs, ss = cc + moments[k, 0], cs + moments[k, 1], ss + moments[k, 2]
                cq, sq, qq = cq + moments[k, 3], sq + moments[k, 4], qq + moments[k, 5]
                det = cc * ss - cs * cs
                chi2 = qq - ((ss * cq - cs * sq) * cq + (cc * sq - cs * cq) * sq) / det
                cost[k] = chi2 if forward else cost[k] + chi2
    nx, ny, rho = 0.8, 0.6, 2.0
    for _ in range(4):
        i00 = i01 = i11 = g0 = g1 = 0.0
        for k in range(n):
            c, s = cosines[k] * nx + sines[k] * ny, sines[k] * nx - cosines[k] * ny
            by_rho = 1.0 / (c * sigma)
            by_alpha, error = -rho * s / c * by_rho, ranges[k] / sigma - rho * by_rho
            i00, i01, i11 = i00 + by_alpha * by_alpha, i01 + by_alpha * by_rho, i11 + by_rho * by_rho
            g0, g1, total = g0 + by_alpha * error, g1 + by_rho * error, total + error * error
        total += i00 + i01 + i11 + g0 + g1
    w0 = w1 = w2 = w3 = w4 = h0 = h1 = h2 = 0.0
    for k in range(n):
        c = cosines[k] * nx + sines[k] * ny
        t, error = rho * (sines[k] * nx - cosines[k] * ny) / c, ranges[k] * c - rho
        weight = 1.0 / (c * sigma) ** 2
        w0, w1, w2, h0 = w0 + weight, w1 + weight * t, w2 + weight * t * t, h0 + weight * error
        w3, w4, h1, h2 = w3 + weight * t**3, w4 + weight * t**4, h1 + weight * t * error, h2 + weight * t * t * error
    return total + w0 + w1 + w2 + w3 + w4 + h0 + h1 + h2
