"""Kernels of correlative search: scores of many motions heading by heading, and the peaks of a posterior on a grid."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inner, njit
from spplanes.segmentation.clustering.ahc import find


@njit(cache=True)
def score_by_heading(
    headings, starts, shifts, cell, points, weight, table, origin, others, other_weight, other_table, other_origin
):
    """Sum of table values under b_T_a = (shift, heading), mean of both ways and weighted: points of a in b and back.

    Motions (M, 2) come in runs of one heading: those of `headings[h]` are `starts[h]` to `starts[h + 1]`. Tables
    are of small integers, so that they stay in the cache, and have a rim of zeros one cell wide, where all that lies
    outside is looked up; the result (M,) is in their unit. Places are in cells, of single precision: where all is 32
    bits wide the loop over points is vectorised.
    """
    result = np.empty(shifts.shape[0])
    places = np.empty(max(points.shape[0], others.shape[0]), np.int32)
    there_u, there_v = np.empty(points.shape[0], np.float32), np.empty(points.shape[0], np.float32)
    back_u, back_v = np.empty(others.shape[0], np.float32), np.empty(others.shape[0], np.float32)
    for h in range(headings.shape[0]):
        c, s = np.cos(headings[h]), np.sin(headings[h])
        for k in range(points.shape[0]):
            there_u[k] = (c * points[k, 0] - s * points[k, 1] - origin[0]) / cell
            there_v[k] = (s * points[k, 0] + c * points[k, 1] - origin[1]) / cell
        for k in range(others.shape[0]):
            back_u[k] = (c * others[k, 0] + s * others[k, 1] - other_origin[0]) / cell
            back_v[k] = (c * others[k, 1] - s * others[k, 0] - other_origin[1]) / cell
        for m in range(starts[h], starts[h + 1]):
            x, y = shifts[m, 0] / cell, shifts[m, 1] / cell
            there = _looked_up(there_u, there_v, x, y, table, places)
            back = _looked_up(back_u, back_v, -c * x - s * y, s * x - c * y, other_table, places)
            result[m] = 0.5 * (weight * there + other_weight * back)
    return result


@inner(cache=True)
def _looked_up(columns, rows, right, up, table, places):
    """Sum of the table's values at points (in cells) that are shifted; `places` takes their indices."""
    shift_u, shift_v, first = np.float32(right), np.float32(up), np.float32(0.0)
    last_u, last_v, width = np.float32(table.shape[1] - 1), np.float32(table.shape[0] - 1), np.int32(table.shape[1])
    for k in range(columns.shape[0]):
        column = min(max(columns[k] + shift_u, first), last_u)
        row = min(max(rows[k] + shift_v, first), last_v)
        places[k] = np.int32(row) * width + np.int32(column)
    values, total = table.reshape(-1), 0
    for k in range(columns.shape[0]):
        total += values[places[k]]
    return total


@njit(cache=True)
def peaks_of(keys, strides, order, scores, prominence):
    """The peak that each cell of a sparse grid belongs to, as the index of its highest cell, shape (N,).

    Cells climb from the highest down (`order`): one without a higher neighbour starts a peak, one between two joins
    them if the lower of both rises by less than `prominence` above it. Their keys (N,) ascend, with a margin between
    rows; `strides` (3,) is what a step along each axis adds to a key.
    """
    parent = np.empty(keys.size, np.int64)
    for index in range(keys.size):
        parent[index] = -1
    for index in order:
        parent[index] = index
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    wanted = keys[index] + i * strides[0] + j * strides[1] + k * strides[2]
                    place = np.searchsorted(keys, wanted)
                    if place == keys.size or keys[place] != wanted or parent[place] < 0:
                        continue
                    one, other = find(parent, index), find(parent, place)
                    if one == other:
                        continue
                    high, low = (one, other) if scores[one] >= scores[other] else (other, one)
                    if low == index or scores[low] - scores[index] < prominence:
                        parent[low] = high
    for index in range(keys.size):
        parent[index] = find(parent, index)
    return parent
