"""Sums over the patches of planes: what the residuals of neighbouring points have in common."""

from __future__ import annotations

from spplanes._jit import njit

#: Patches along each side of a plane.
SIDE = 5
#: Of a patch: number, sum of the weights, weighted residual, its square, weighted x and y.
N, WEIGHT, RESIDUAL, SQUARE, X, Y = range(6)


@njit(cache=True)
def add_to_patches(points, variances, groups, frames, half, sums):
    """Add every point's residual to the sums (P, SIDE, SIDE, 6) of its patch, in place. Points (N, 3), m, of ``groups``
    (N,), -1 = none, have ``variances`` (N, 1) or (N, 9), or (1, .) for all, m^2. ``half`` (P, 2), m, are half the sides
    of the rectangles that are parted; points beyond are of the rim."""
    step = 1 if variances.shape[0] == points.shape[0] else 0
    isotropic = variances.shape[1] == 1
    for k in range(points.shape[0]):
        g = groups[k]
        if g < 0:
            continue
        f = frames[g]
        a, b, c = points[k, 0] - f[0, 3], points[k, 1] - f[1, 3], points[k, 2] - f[2, 3]
        x = a * f[0, 0] + b * f[1, 0] + c * f[2, 0]
        y = a * f[0, 1] + b * f[1, 1] + c * f[2, 1]
        n0, n1, n2 = f[0, 2], f[1, 2], f[2, 2]
        z = a * n0 + b * n1 + c * n2
        v = variances[k * step]
        if isotropic:
            along = v[0]
        else:
            along = n0 * (n0 * v[0] + n1 * (v[1] + v[3]) + n2 * (v[2] + v[6]))
            along += n1 * (n1 * v[4] + n2 * (v[5] + v[7])) + n2 * n2 * v[8]
            along = max(along, 1e-3 * (v[0] + v[4] + v[8]))
        i = int(min(max((x / half[g, 0] + 1.0) * 0.5 * SIDE, 0.0), SIDE - 1.0))
        j = int(min(max((y / half[g, 1] + 1.0) * 0.5 * SIDE, 0.0), SIDE - 1.0))
        w, cell = 1.0 / along, sums[g, i, j]
        cell[0] += 1.0
        cell[1] += w
        cell[2] += w * z
        cell[3] += w * z * z
        cell[4] += w * x
        cell[5] += w * y
