"""Kernels of laser odometry: point-to-line alignment to a local map, and search for where it should begin."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, njit
from spplanes._rows import solve3

#: Returns weigh a quarter at so many standard deviations.
_DOUBTED = 3.0


@inlined
def _surface_at(x, y, nx, ny, there):
    """The surface of a map's `Cells` at a place: whether there is one, its signed distance and its normal.

    It is that of the points within a cell's width whose normals are alike.
    """
    smooth_m = 0.08  # width of the weights with which points make the surface
    column = int(np.floor((x - there.origin[0]) / there.cell))
    row = int(np.floor((y - there.origin[1]) / there.cell))
    weight = qx = qy = mx = my = 0.0
    for r in range(max(row - 1, 0), min(row + 2, there.rows)):
        for c in range(max(column - 1, 0), min(column + 2, there.columns)):
            home = r * there.columns + c
            for k in range(there.start[home], there.start[home + 1]):
                if there.normals[k, 0] * nx + there.normals[k, 1] * ny < 0.7:
                    continue
                dx, dy = there.points[k, 0] - x, there.points[k, 1] - y
                squared = dx * dx + dy * dy
                if squared > there.cell * there.cell:
                    continue
                near = there.weights[k] / (smooth_m * smooth_m + squared) ** 2
                weight += near
                qx += near * dx
                qy += near * dy
                mx += near * there.normals[k, 0]
                my += near * there.normals[k, 1]
    length = np.sqrt(mx * mx + my * my)
    if weight == 0.0 or length == 0.0:
        return False, 0.0, 0.0, 0.0
    mx, my = mx / length, my / length
    return True, -(mx * qx + my * qy) / weight, mx, my


@inlined
def _turned(rows, i, c, s):
    """Row i of some (N, 2), turned by an angle of this cosine and sine."""
    return c * rows[i, 0] - s * rows[i, 1], s * rows[i, 0] + c * rows[i, 1]


@njit(cache=True)
def align(pose, scan, there, expected, information):
    """Gauss-Newton on robust point-to-line distances and a normal prior about `expected` (x, y, theta).

    Args:
        pose: where to start, shape (3,).
        scan: its `Surface`.
        there: `Cells` of the map.
        expected, information: the prior, shapes (3,) and (3, 3).

    Returns:
        pose (3,); information (3, 3) of the returns alone, in the map's axes, and what errs of it; distance at which
        they turn the scan, m; share of the looks that fit; misfit: half of the chi2 of the looks near a surface,
        bounded for each, beyond what it is expected to be.
    """
    pose, told, pull = pose.copy(), np.zeros((3, 3)), np.zeros(3)
    for step in range(15):
        _write_told(pose, scan, there, 0.24 * 0.5**step, told, pull)  # what is far off counts less in each round
        for a in range(3):
            for b in range(3):
                pull[a] += information[a, b] * (expected[b] - pose[b])
        whole = (
            told[0, 0] + information[0, 0], told[0, 1] + information[0, 1], told[0, 2] + information[0, 2],
            told[1, 1] + information[1, 1], told[1, 2] + information[1, 2], told[2, 2] + information[2, 2],
        )  # fmt: skip
        change = solve3(whole, pull[0], pull[1], pull[2])
        for a in range(3):
            pose[a] += change[a]
        if step > 3 and abs(change[0]) + abs(change[1]) < 2e-4 and abs(change[2]) < 2e-5:
            break
    erring, far, fit, misfit = _judged(pose, scan, there)
    return pose, told, erring, far, fit, misfit


@inlined
def _write_told(pose, scan, there, wide, told, pull):
    """Write what returns say of a pose, information (3, 3), and where they pull it, (3,), doubted beyond `wide`, m."""
    for a in range(3):
        pull[a] = 0.0
        for b in range(3):
            told[a, b] = 0.0
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for i in range(scan.points.shape[0]):
        lx, ly = _turned(scan.points, i, c, s)
        nx, ny = _turned(scan.normals, i, c, s)
        met, off, mx, my = _surface_at(pose[0] + lx, pose[1] + ly, nx, ny, there)
        if not met:
            continue
        scale = max(_DOUBTED * _DOUBTED * scan.variance[i], wide * wide)
        weight = scan.looks[i] / scan.variance[i] / (1.0 + off * off / scale) ** 2
        j2 = -mx * ly + my * lx
        told[0, 0] += weight * mx * mx
        told[0, 1] += weight * mx * my
        told[0, 2] += weight * mx * j2
        told[1, 1] += weight * my * my
        told[1, 2] += weight * my * j2
        told[2, 2] += weight * j2 * j2
        pull[0] -= weight * mx * off
        pull[1] -= weight * my * off
        pull[2] -= weight * j2 * off
    told[1, 0], told[2, 0], told[2, 1] = told[0, 1], told[0, 2], told[1, 2]


@inlined
def _judged(pose, scan, there):
    """What errs of the information (3, 3), distance at which returns turn the scan, share that fits, and misfit.

    Normals err: those of one wall differ, and seem to tell something along it. Of a normal that errs by an angle of
    mean square sine v, n n^T is expected to hold v t t^T, t along the wall; that much is taken off the information,
    with v of the scan's normal: the map's, a mean of several, errs by less.
    """
    fits = total = misfit = looked = moment = 0.0
    erring, c, s = np.zeros((3, 3)), np.cos(pose[2]), np.sin(pose[2])
    for i in range(scan.points.shape[0]):
        lx, ly = _turned(scan.points, i, c, s)
        nx, ny = _turned(scan.normals, i, c, s)
        met, off, mx, my = _surface_at(pose[0] + lx, pose[1] + ly, nx, ny, there)
        squared = off * off / scan.variance[i] if met else np.inf
        if met:
            misfit += 0.5 * scan.looks[i] * (min(squared, _DOUBTED * _DOUBTED) - 1.0)
            weight = scan.looks[i] / scan.variance[i] / (1.0 + squared / (_DOUBTED * _DOUBTED)) ** 2
            looked += weight
            moment += weight * (lx * lx + ly * ly)
            along, t2 = weight * scan.turns[i], mx * lx + my * ly  # of t = (-my, mx)
            erring[0, 0] += along * my * my
            erring[0, 1] -= along * my * mx
            erring[0, 2] -= along * my * t2
            erring[1, 1] += along * mx * mx
            erring[1, 2] += along * mx * t2
            erring[2, 2] += along * t2 * t2
        total += scan.looks[i]
        if squared < _DOUBTED * _DOUBTED:
            fits += scan.looks[i]
    erring[1, 0], erring[2, 0], erring[2, 1] = erring[0, 1], erring[0, 2], erring[1, 2]
    far = np.sqrt(max(moment / max(looked, 1e-12), 1e-6))
    return erring, far, fits / max(total, 1e-12), misfit


@njit(cache=True)
def score_box(scan, looks, pose, table, origin, cell, turns, steps):
    """Mean nearness of the returns to the map for every turn (T,) and shift of -steps..steps cells: (T, S, S)."""
    rows, columns = table.shape
    side = 2 * steps + 1
    scores = np.zeros((turns.shape[0], side, side))
    total = 0.0
    for i in range(looks.shape[0]):
        total += looks[i]
    for t in range(turns.shape[0]):
        c, s = np.cos(pose[2] + turns[t]), np.sin(pose[2] + turns[t])
        for i in range(scan.shape[0]):
            x = (pose[0] + c * scan[i, 0] - s * scan[i, 1] - origin[0]) / cell
            y = (pose[1] + s * scan[i, 0] + c * scan[i, 1] - origin[1]) / cell
            column, row = int(np.floor(x)) - steps, int(np.floor(y)) - steps
            first, last = max(-column, 0), min(columns - column, side)
            for b in range(max(-row, 0), min(rows - row, side)):
                if first < last:  # by slices: a loop without a question in it is vectorised
                    sums, near = scores[t, b, first:last], table[row + b, column + first : column + last]
                    for a in range(sums.shape[0]):
                        sums[a] += looks[i] * near[a]
    scores /= max(total, 1e-12)
    return scores
