"""Patches become regions: planar cells fuse with each other and with regions, regions with those they meet."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.special import chdtri, ndtri  # scipy.stats would take 0.7 s of every import

from spplanes._check import FloatArray
from spplanes._jit import inlined, njit
from spplanes._rows import copy_into
from spplanes._threads import in_parts
from spplanes.fitting._moment_patches import distance_of, variance_from
from spplanes.outlines._raster import distinct_pairs
from spplanes.segmentation.clustering import cells, growing
from spplanes.segmentation.clustering.ahc import cluster
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.sheet import Sheet, append, fuse, is_determined

CELL_SLACK = 1.15
"""Mean squared residual of a planar cell may exceed the noise model by this factor: sensors are known to 7 %."""
HIDDEN = 3.0
"""Widest occluder behind which a plane is taken to continue, in widths (points) of the smaller of its two parts."""


def join_cells(sheet: Sheet, quads: np.ndarray, size: int, config: MapperConfig) -> None:
    """Find planar cells among the free points, fuse them with each other and with the regions."""
    floor, free = config.flatness_m**2, sheet.free
    given = sheet.points[sheet.fresh], sheet.covariance[sheet.fresh], free, size, floor
    moments = cells.cell_moments(*given)
    failed = cells.failed_quads(free, quads, size)
    planar = cells.planar_cells(moments, failed, size, -ndtri(config.significance), CELL_SLACK)
    shared = sheet.shared[sheet.fresh] if len(sheet.shared) > 1 else sheet.shared
    if size > cells.STRIPS and len(shared) == 1:
        limit = CELL_SLACK * chdtri(1, config.significance / (2 * cells.STRIPS))
        cells.reject_steps(planar, given, moments, limit)
    if not planar.any():
        return
    bias = cells.shared_variances(moments, shared, free, planar, size, sheet.start)
    n_regions = len(sheet.rows)
    node = np.where(planar, n_regions + np.cumsum(planar.ravel()).reshape(planar.shape) - 1, -1)
    nodes, biases = np.concatenate((sheet.rows, moments[planar])), np.concatenate((sheet.bias, bias))
    edges = cells.cell_edges(node, sheet.labels, sheet.start, size)
    root = cluster_patches(nodes, biases, edges, config)
    sheet.rows, sheet.bias = nodes[:n_regions], biases[:n_regions]
    fuse(sheet, root[:n_regions])
    fresh = [r for r in np.unique(root) if r >= n_regions and is_determined(nodes[r], config)]
    label_of = np.full(len(nodes), -1, dtype=np.int64)
    label_of[:n_regions] = np.arange(n_regions)
    label_of[fresh] = n_regions + np.arange(len(fresh))
    append(sheet, nodes[fresh], biases[fresh])
    of_cells = np.where(planar, label_of[root][node], -1)
    of_points = np.repeat(np.repeat(of_cells, size, axis=0), size, axis=1)[: free.shape[0], : free.shape[1]]
    np.copyto(sheet.labels[sheet.fresh], of_points, where=free & (of_points >= 0))


def cluster_patches(
    rows: FloatArray, bias: FloatArray, edges: np.ndarray, config: MapperConfig, flatness_m: float | None = None
) -> np.ndarray:
    """Root of every patch; rows and bias are those of the trees afterwards. See `cluster`.

    The test for a step between two parallel planes refuses 5e-5 of the true fusions, that of offset and tilt 0.0125:
    patches meet several times, and what is refused once is fused by way of others. Where scans share errors, both go by
    `MapperConfig.significance`: the size of such errors is hardly ever known to more.
    """
    flatness = config.flatness_m if flatness_m is None else flatness_m
    known = not bias[:, 0].any()
    limits = chdtri(np.array([1, 3]), (5e-5, 0.0125) if known else config.significance)
    return cluster(rows, bias, edges, limits, flatness, max(config.pose_correlation_scans, 1.0))


def fuse_neighbours(sheet: Sheet, views: FloatArray, gap: int, config: MapperConfig) -> None:
    """Fuse regions that meet and are one plane (chi2)."""
    planes = growing.hesse(sheet.rows)
    sheet.bias = growing.shared_of_regions(sheet.shared, sheet.labels, planes)
    regions = planes, np.ascontiguousarray(sheet.rows[:, 0]), config.flatness_m**2 + sheet.bias[:, 0]
    found: list[np.ndarray] = []
    pairs_of_rows = partial(_pairs_of_rows, sheet.grid, views, regions, gap)
    in_parts(lambda first, last: found.append(pairs_of_rows(first, last)), len(sheet.labels), sheet.labels.size)
    edges = distinct_pairs(np.concatenate(found), len(sheet.rows))
    if len(edges):
        fuse(sheet, cluster_patches(sheet.rows, sheet.bias, edges, config))


@njit(cache=True)
def _pairs_of_rows(grid, views, regions, gap, first, last):
    """Pairs (E, 2) of unlike regions, one in the rows from first to last, the other beside or above it, that touch, or
    that an occluder parts along a row or column. Some come several times, and in no particular order.

    With an occluder, the points between lie clearly before the plane; at most `gap` of them are missing, up to four of
    its edges lie on the plane. It is at most `gap` points wide, or `HIDDEN` times as wide as the smaller region, which
    else would not tell what is behind it. A gap of 0 asks for regions that touch. Points on the plane or behind it, a
    seam or a doorway, show that the surface ends. `regions` are planes, numbers of points and tolerances, m^2.
    """
    (points, covariance, valid, labels, _), (planes, sizes, bias) = grid, regions
    pairs, count = np.empty((1024, 2), dtype=np.int64), 0
    recent = np.full((256, 2), -1, dtype=np.int64)  # pairs found last, by which most repetitions are left out
    for i in range(first, last):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r < 0:
                continue
            for along in range(2):
                before = j if along == 0 else i
                if before == 0 or r == (labels[i, j - 1] if along == 0 else labels[i - 1, j]):
                    continue
                on_plane, in_front, missing = 0, 0, 0
                widest = max(gap, int(HIDDEN * np.sqrt(sizes[r]))) if gap else 0
                farthest = min(widest + 1, before)
                for back in range(1, farthest + 1):
                    a, b = (i, j - back) if along == 0 else (i - back, j)
                    q = labels[a, b]
                    if q == r:
                        break
                    near = back <= gap + 1 or back <= HIDDEN * np.sqrt(sizes[max(q, 0)])
                    if q >= 0 and near and (back == 1 or in_front > 0):
                        if count == pairs.shape[0]:
                            room = np.empty((2 * count, 2), dtype=np.int64)
                            copy_into(room, pairs)
                            pairs = room
                        count += _enter(pairs, count, recent, min(q, r), max(q, r))
                    if back == farthest:
                        break
                    missing += not valid[a, b]
                    if missing > gap:
                        break
                    side = _side(points, covariance, (a, b), views, planes, r, bias[r]) if valid[a, b] else 1
                    if side > 0:
                        in_front += 1
                    elif side == 0 and q < 0 and on_plane < 4:
                        on_plane += 1
                    else:
                        break
    return pairs[:count]


@inlined
def _enter(pairs, count, recent, q, r):
    """Put a pair down unless it was there lately; returns whether."""
    place = (31 * q + r) % recent.shape[0]
    if recent[place, 0] == q and recent[place, 1] == r:
        return 0
    recent[place, 0], recent[place, 1] = q, r
    pairs[count, 0], pairs[count, 1] = q, r
    return 1


@inlined
def _side(points, covariance, place, views, planes, r, bias):
    """1: the point lies before the plane, on the viewpoint's side; -1: behind it; 0: within its noise and tolerance."""
    i, j = place
    distance = distance_of(points, i, j, planes, r)
    eye = views[i, 0] * planes[r, 0] + views[i, 1] * planes[r, 1] + views[i, 2] * planes[r, 2] - planes[r, 3]
    if distance * distance <= 9.0 * variance_from(covariance, i, j, planes, r) + 25.0 * bias:
        return 0
    return 1 if distance * eye > 0.0 else -1
