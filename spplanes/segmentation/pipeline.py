"""`segment_scans`: planes of an organised grid of points, from coarse cells to single points."""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2, norm

from spplanes._check import FloatArray
from spplanes.moments import ROW_SIZE
from spplanes.segmentation import cells, growing
from spplanes.segmentation._patches import eigenvalues
from spplanes.segmentation.clustering import cluster
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.quads import links

CELL_SLACK = 1.3
"""Mean squared residual of a planar cell may exceed the noise model by this factor: sensors are known to 15 %."""
BORDER_GAP = 3
"""Regions with up to this many lost points between them still meet."""


def segment_grid(
    points: FloatArray,
    covariance: FloatArray,
    shared: FloatArray,
    valid: np.ndarray,
    views: FloatArray,
    config: MapperConfig,
) -> np.ndarray:
    """Label the points of a grid by plane, shape (S, B) int64; -1 = none. Labels are 0..K-1 in order of first point.

    `covariance` is all of a point's uncertainty, `shared` (S, B, 1) or (S, B, 9) the part it shares with its scan,
    which more points do not average away.
    """
    tangent = float(np.tan(config.max_incidence_rad))
    right, down = links(points, covariance, valid, views, tangent, chi2.isf(config.edge_significance, 1))
    labels, free = np.full(valid.shape, -1, dtype=np.int64), valid.copy()
    rows, bias = np.empty((0, ROW_SIZE)), np.empty(0)
    size = config.largest_cell
    while size >= config.smallest_cell:
        rows, bias = _cell_level(points, covariance, shared, labels, free, (right, down), rows, bias, size, config)
        size //= 2
    return _finish(points, covariance, shared, labels, free, valid, rows, config)


def _cell_level(points, covariance, shared, labels, free, linked, rows, bias, size, config):
    """Find planar cells among the free points, fuse them with each other and with the regions; return the regions."""
    floor = config.flatness_m**2
    moments = cells.cell_moments(points, covariance, free, size, floor)
    broken = cells.broken_links(free, linked[0], linked[1], size)
    planar = cells.planar_cells(moments, broken, size, norm.isf(config.significance), CELL_SLACK)
    if not planar.any():
        return rows, bias
    node = np.where(planar, len(rows) + np.cumsum(planar.ravel()).reshape(planar.shape) - 1, -1)
    nodes = np.concatenate((rows, moments[planar]))
    cell_bias = cells.shared_variances(moments, shared, free, planar, size)
    bias = np.concatenate((bias, cell_bias + floor))
    edges = cells.cell_edges(node, labels, size)
    root = cluster(nodes, bias, edges, chi2.isf(config.significance, 3))
    kept = _relabel(labels, free, node, nodes, root, len(rows), size, config)
    return nodes[kept], bias[kept]


def _relabel(labels, free, node, nodes, root, n_regions, size, config) -> list:
    """Keep old regions and new clusters that determine a plane, numbered without gaps; paint their cells."""
    kept = [r for r in np.unique(root) if r < n_regions or _is_determined(nodes[r], config)]
    number = np.full(len(nodes), -1, dtype=np.int64)
    number[kept] = np.arange(len(kept))
    label_of = number[root]
    if n_regions:
        labels[labels >= 0] = label_of[labels[labels >= 0]]
    cells.paint(labels, node, label_of, free, size)
    return kept


def _is_determined(row: FloatArray, config: MapperConfig) -> bool:
    """Whether the smaller of the two tilts is known to max_tilt_rad."""
    return eigenvalues(row)[1] * config.max_tilt_rad**2 >= 1.0


def _finish(points, covariance, shared, labels, free, valid, rows, config) -> np.ndarray:
    """Grow to single points, fuse regions that are one plane, settle borders, drop what is too small."""
    floor, gate = config.flatness_m**2, config.gate_sigma**2
    for _ in range(2):
        if not len(rows):
            break
        rows = growing.fit_regions(points, covariance, labels, rows, floor)
        growing.grow(points, covariance, labels, free, growing.hesse(rows), gate, floor)
        rows = growing.fit_regions(points, covariance, labels, rows, floor)
        bias = floor + growing.shared_of_regions(shared, labels, growing.hesse(rows))
        rows = _fuse(labels, rows, bias, chi2.isf(config.significance, 3))
        labels[~valid] = -2
        for _ in range(3):
            planes = growing.hesse(rows)
            if not growing.choose_at_borders(points, covariance, labels, planes, gate, floor, config.border_smoothness):
                break
        labels[~valid] = -1
        free = valid & (labels < 0)
        rows = _compact(labels, rows, config)
        free = valid & (labels < 0)
    return labels


def _fuse(labels, rows, bias, limit) -> FloatArray:
    pairs = growing.border_pairs(labels, BORDER_GAP)
    if not len(pairs):
        return rows
    codes = np.unique(pairs[:, 0] * len(rows) + pairs[:, 1])
    root = cluster(rows, bias, np.stack((codes // len(rows), codes % len(rows)), axis=1), limit)
    labels[labels >= 0] = root[labels[labels >= 0]]
    return rows


def _compact(labels, rows, config) -> FloatArray:
    """Drop regions that are small or undetermined and number the rest by their first point."""
    used = labels[labels >= 0]
    counts = np.bincount(used, minlength=len(rows))
    keep = (counts >= config.min_points) & np.array([_is_determined(row, config) for row in rows], dtype=bool)
    first = np.full(len(rows), labels.size)
    np.minimum.at(first, used, np.flatnonzero(labels.ravel() >= 0))
    order = np.argsort(first, kind="stable")
    order = order[keep[order]]
    number = np.full(len(rows), -1, dtype=np.int64)
    number[order] = np.arange(len(order))
    labels[labels >= 0] = number[used]
    return rows[order]
