"""Patches become regions: planar cells fuse with each other and with regions, regions with their neighbours."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri, ndtri  # scipy.stats would take 0.7 s of every import

from spplanes._check import FloatArray
from spplanes.outlines._raster import distinct
from spplanes.segmentation.clustering import cells, growing, meeting, steps
from spplanes.segmentation.clustering.ahc import cluster
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.sheet import Sheet, append, fuse, is_determined

CELL_SLACK = 1.15
"""Mean squared residual of a planar cell may exceed the noise model by this factor: sensors are known to 7 %."""
STEP_SIGNIFICANCE = 5e-5
"""Share of the true fusions that the test for a step between two parallel planes may refuse."""
FUSE_SIGNIFICANCE = 0.0125
"""Share of the true fusions that the test of offset and tilt may refuse: patches meet several times, and what is
refused once is fused by way of others. Where scans share errors, both tests go by `MapperConfig.significance`: the size
of such errors is hardly ever known to more."""
HIDDEN = 3.0
"""Widest occluder behind which a plane is taken to continue, in widths (points) of the smaller of its two parts."""


def join_cells(sheet: Sheet, quads: np.ndarray, size: int, config: MapperConfig) -> None:
    """Find planar cells among the free points, fuse them with each other and with the regions."""
    floor, free = config.flatness_m**2, sheet.free
    given = sheet.points[sheet.fresh], sheet.covariance[sheet.fresh], free, size, floor
    moments = cells.cell_moments(*given)
    failed = cells.failed_quads(free, quads, size)
    planar = cells.planar_cells(moments, failed, free.shape, size, -ndtri(config.significance), CELL_SLACK)
    shared = sheet.shared[sheet.fresh] if len(sheet.shared) > 1 else sheet.shared
    if size > steps.STRIPS and len(shared) == 1:
        limit = CELL_SLACK * chdtri(1, config.significance / (2 * steps.STRIPS))
        steps.reject_steps(planar, given, moments, limit)
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
    cells.paint(sheet.labels[sheet.fresh], node, label_of[root], free, size)


def cluster_patches(
    rows: FloatArray, bias: FloatArray, edges: np.ndarray, config: MapperConfig, flatness_m: float | None = None
) -> np.ndarray:
    """Root of every patch; rows and bias are those of the trees afterwards. See `cluster`."""
    flatness = config.flatness_m if flatness_m is None else flatness_m
    known = not bias[:, 0].any()
    limits = chdtri(np.array([1, 3]), (STEP_SIGNIFICANCE, FUSE_SIGNIFICANCE) if known else config.significance)
    return cluster(rows, bias, edges, limits, flatness, max(config.pose_correlation_scans, 1.0))


def fuse_neighbours(sheet: Sheet, views: FloatArray, gap: int, config: MapperConfig) -> None:
    """Fuse regions that meet and are one plane (chi2)."""
    planes = growing.hesse(sheet.rows)
    sheet.bias = growing.shared_of_regions(sheet.shared, sheet.labels, planes)
    regions = planes, np.ascontiguousarray(sheet.rows[:, 0]), config.flatness_m**2 + sheet.bias[:, 0]
    pairs = meeting.border_pairs(sheet.grid, views, regions, gap, HIDDEN)
    edges = distinct_pairs(pairs, len(sheet.rows))
    if len(edges):
        fuse(sheet, cluster_patches(sheet.rows, sheet.bias, edges, config))


def distinct_pairs(pairs: np.ndarray, n_regions: int) -> np.ndarray:
    """Each pair once, in ascending order, shape (E, 2)."""
    codes = distinct(pairs[:, 0] * n_regions + pairs[:, 1])
    return np.stack(np.divmod(codes, max(n_regions, 1)), axis=1)
