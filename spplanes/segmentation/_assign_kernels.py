"""Points of cells are given to the planes that reach into them or beside them."""

from __future__ import annotations

from spplanes._jit import njit


@njit(cache=True)
def assign(points, variances, bounds, first, candidates, planes, tolerance, gate, labels):
    """Give every point the plane of its cell's candidates that it fits best, within the gate, in place.

    Args:
        points, variances: shape (N, 3), m, and (N,), m^2.
        bounds: of the runs of points that are cells, shape (C + 1,).
        first, candidates: planes of cell c are candidates[first[c]:first[c + 1]].
        planes: (normal, d), shape (R, 4).
        tolerance: variance that a surface is granted beside the noise of its points, shape (R,), m^2.
        gate: largest chi2.
        labels: plane of every point, shape (N,), -1 = none.

    Returns:
        Number of points that changed.
    """
    changed = 0
    for c in range(bounds.shape[0] - 1):
        if first[c] == first[c + 1]:
            continue
        for k in range(bounds[c], bounds[c + 1]):
            best, label = gate, -1
            for m in range(first[c], first[c + 1]):
                r = candidates[m]
                off = points[k, 0] * planes[r, 0] + points[k, 1] * planes[r, 1] + points[k, 2] * planes[r, 2]
                off -= planes[r, 3]
                chi2 = off * off / (variances[k] + tolerance[r])
                if chi2 <= best:
                    best, label = chi2, r
            changed += label != labels[k]
            labels[k] = label
    return changed
