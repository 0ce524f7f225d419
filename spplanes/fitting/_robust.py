"""A plane fit that gross outliers cannot pull: a deterministic consensus start, then Tukey's biweight.

The scale of the residuals is known, as every point brings its covariance; nothing is estimated from the spread.

References:
    Beaton, Tukey, "The fitting of power series", Technometrics 16, 1974 (the biweight).
    Torr, Zisserman, "MLESAC", CVIU 78, 2000 (scoring hypotheses by a truncated cost).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import inlined, inner
from spplanes._rows import COLLINEAR, OK, add_square, column, copy_into, cross, dot, in_frame, minus, over, write_frame
from spplanes.fitting._kernels import descend, invert3, settle, write_covariance
from spplanes.fitting._sums import FLOOR

#: Tukey's constant: 95 % efficient on clean Gaussian points, and blind to what is farther than this many sigma.
CUTOFF = 4.685
#: Where the triples come from that are tried: fractions of the group, the same in every run. With 30 % outliers, all
#: hundred of them hold one with a chance of 1e-18.
FRACTIONS = np.random.default_rng(0).random((100, 3))


def _biweight_means(density: Callable[[FloatArray], FloatArray]) -> tuple[float, float, float]:
    """Means over u of the weight (1 - q)^2, of psi' and of psi^2, where q = u^2 / CUTOFF^2 <= 1."""
    u = np.linspace(-CUTOFF, CUTOFF, 20001)
    p, q = density(u), (u / CUTOFF) ** 2
    weight, slope, score = (1 - q) ** 2, (1 - q) * (1 - 5 * q), u**2 * (1 - q) ** 4
    return float(np.trapezoid(weight * p, u)), float(np.trapezoid(slope * p, u)), float(np.trapezoid(score * p, u))


#: Means over inliers, standard normal, and over outliers, spread evenly over the band.
WEIGHT, SLOPE, SCORE = _biweight_means(lambda u: np.exp(-0.5 * u * u) / math.sqrt(2.0 * math.pi))
OUT_WEIGHT, _, OUT_SCORE = _biweight_means(lambda u: np.full_like(u, 0.5 / CUTOFF))


@inlined
def triple_frame(points, i, j, k, frame) -> bool:
    """Write the frame of the plane through three points; False where they are as good as collinear, or not three."""
    a, b = minus(points[j], points[i]), minus(points[k], points[i])
    normal, length2 = cross(a, b), dot(a, a)
    area = math.sqrt(dot(normal, normal))
    if not area > 1e-6 * max(length2, dot(b, b)):
        return False
    write_frame(over(normal, area), over(a, math.sqrt(length2)), points[i], frame)
    return True


@inner(cache=True)
def locate(group, k, frame) -> tuple[float, float, float, float]:
    """A group's k-th point in a frame, x, y, z, m, and its variance along z: no less than `FLOOR` of the trace."""
    points, covs, order, _, _ = group
    i = order[k]
    c, (nx, ny, nz) = covs[min(i, covs.shape[0] - 1)], column(frame, 2)
    variance = nx * nx * c[0, 0] + ny * ny * c[1, 1] + nz * nz * c[2, 2]
    variance += 2.0 * (nx * ny * c[0, 1] + nx * nz * c[0, 2] + ny * nz * c[1, 2])
    return *in_frame(points, i, frame), max(variance, FLOOR * (c[0, 0] + c[1, 1] + c[2, 2]))


@inner(cache=True)
def consensus_frame(group, fractions, cutoff2, frame) -> int:
    """Write the frame of the triple whose plane the group agrees with most."""
    points, _, order, lo, hi = group
    n = hi - lo
    stride = max(1, n // 500)  # some 500 points, evenly spread, judge a triple
    trial, best = np.empty((4, 4)), np.inf
    for t in range(fractions.shape[0]):
        i = order[lo + int(fractions[t, 0] * n)]
        j = order[lo + int(fractions[t, 1] * n)]
        k = order[lo + int(fractions[t, 2] * n)]
        if not triple_frame(points, i, j, k, trial):
            continue
        cost = 0.0
        for m in range(lo, hi, stride):
            _, _, z, variance = locate(group, m, trial)
            cost += min(z * z / variance, cutoff2)
        if cost < best:
            best = cost
            copy_into(frame, trial)
    return OK if best < np.inf else COLLINEAR


@inner(cache=True)
def patch_points(group, frame, cutoff2, kept) -> int:
    """Write to ``kept`` the group's points over the patch its inliers fill, at whatever height; returns how many. A
    gross outlier that happens to lie near the plane but far out along it would have all the leverage on the slope. Mean
    and spread are of the points within ``cutoff2`` and the patch, until the patch no longer changes."""
    _, _, order, lo, hi = group
    mx = my = xx = xy = yy = 0.0
    sums, before = np.empty(6), -1.0
    for turn in range(10):
        sums[:] = 0.0
        for k in range(lo, hi):
            x, y, z, variance = locate(group, k, frame)
            if z * z / variance < cutoff2 and (turn == 0 or within_patch(x - mx, y - my, xx, xy, yy)):
                add_square(sums, 1.0, (1.0, x, y))
        n = sums[0]
        if n < 3.0:
            return 0
        mx, my = sums[1] / n, sums[2] / n
        xx, xy, yy = sums[3] / n - mx * mx, sums[4] / n - mx * my, sums[5] / n - my * my
        if n == before:
            break
        before = n
    size = 0
    for k in range(lo, hi):
        x, y, _, _ = locate(group, k, frame)
        if within_patch(x - mx, y - my, xx, xy, yy):
            kept[size] = order[k]
            size += 1
    return size


@inlined
def within_patch(x, y, xx, xy, yy) -> bool:
    """Whether (x, y) is within 4 sigma of a spread; an evenly filled rectangle has 2.5 at its corners."""
    return yy * x * x - 2.0 * xy * x * y + xx * y * y <= 16.0 * (xx * yy - xy * xy)


@inner(cache=True)
def discount_outliers(sums, ring, score) -> None:
    """Turn the weights' information in ``sums`` into the curvature of the cost, and write the variance of its score.
    Inliers bring curvature SLOPE and variance SCORE; outliers within the cutoff, whose information without Tukey's
    weights, sum w h h^T, is as ``ring`` (6,), no curvature but variance OUT_SCORE. They are believed in as far as a
    fifth of the information is left without them."""
    inverse, left, part = np.empty((3, 3)), np.empty(6), OUT_WEIGHT
    while True:
        for k in range(6):
            left[k] = 0.8 * sums[4 + k] - part * ring[k]
        if invert3(left, inverse):
            break
        part = 0.5 * part if part > 1e-3 else 0.0
    for k in range(6):
        inliers = (sums[4 + k] - part * ring[k]) / WEIGHT
        score[k] = SCORE * inliers + part / OUT_WEIGHT * OUT_SCORE * ring[k]
        sums[4 + k] = SLOPE * inliers
    for k in range(15, 18):
        sums[k] *= SLOPE / WEIGHT


@inner(cache=True)
def robust_group(group, viewpoint, fractions, frame, covariance, sums) -> int:
    """Tukey fit of one group; writes frame, covariance and the sums of the kept points at the minimum."""
    points, covs, _, lo, hi = group
    base, wide, narrow = np.empty((4, 4)), 4.0 * CUTOFF * CUTOFF, CUTOFF * CUTOFF
    status = consensus_frame(group, fractions, wide, base)
    if status != OK:
        return status
    kept = np.empty(hi - lo, np.int64)
    patch = points, covs, kept, 0, patch_points(group, base, wide, kept)
    for cutoff2 in (wide, narrow):
        if status == OK:  # by the weights' information a step falls short of what the cost's expected curvature says
            status = descend(patch, cutoff2, WEIGHT / SLOPE, base, sums)
    to_p, ring, score = np.empty((3, 3)), np.zeros(6), np.empty(6)
    if status == OK:
        status = settle(base, sums, viewpoint, frame, to_p)
    if status != OK:
        return status
    for k in range(patch[4]):  # outliers one to two cutoffs off, as many as hide within it where they are spread evenly
        x, y, z, variance = locate(patch, k, base)
        if narrow <= z * z / variance < 4.0 * narrow:
            add_square(ring, 1.0 / variance, (1.0, x, y))
    discount_outliers(sums, ring, score)
    return write_covariance(sums, score, to_p, covariance)
