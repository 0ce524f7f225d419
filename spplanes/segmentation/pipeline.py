"""From an organised grid of points to labelled regions: coarse cells first, single points last."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri, ndtri  # scipy.stats would take 0.7 s of every import

from spplanes._check import FloatArray
from spplanes._raster import distinct
from spplanes.moments import ROW_SIZE, merge_rows
from spplanes.segmentation import borders, cells, creases, dissolving, growing
from spplanes.segmentation._patches import eigenvalues
from spplanes.segmentation.clustering import cluster
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.quads import links, surviving_quads

CELL_SLACK = 1.15
"""Mean squared residual of a planar cell may exceed the noise model by this factor: sensors are known to 7 %."""
BORDER_GAP = 12
"""Most points along a row or column that may be missing where a plane is taken to continue: a beam, a pole."""
HIDDEN = 100
"""Widest occluder, points along a row or column, behind which a plane is taken to continue; it stands before it."""
STEP_SIGNIFICANCE = 5e-5
"""Share of the true fusions that the test for a step between two parallel planes may refuse."""
FUSE_SIGNIFICANCE = 0.0125
"""Share of the true fusions that the test of offset and tilt may refuse: patches meet several times, and what is
refused once is fused by way of others. Where scans share errors, both tests go by `MapperConfig.significance`: the size
of such errors is hardly ever known to more."""
MISFIT_CELL = 8
"""Side of the cells in which the points of a region are searched for a common offset from its plane."""
MISFIT_SIGNIFICANCE = 1e-4
"""Share of such cells that may be found by chance; there are many of them."""
CREASE_CERTAINTY = 3.0
"""Standard deviations of a local normal by which a crease must exceed the angle allowed."""
NEAR = 40
"""Points along a row or column within which a larger plane may explain a small region as well."""
BORDER_BLOCKS = (8, 8, 4)
"""Sides of the blocks of points that change sides together, sweep after sweep."""
BORDER_SWEEPS = 2
"""Sweeps over the points at borders; more change next to nothing."""
ROUNDS = 2
"""The search starts again, once, with the points that turned out not to fit."""


@dataclass(eq=False)
class Sheet:
    """A grid of points while it is being labelled, after the regions that reach into it from earlier scans."""

    points: FloatArray
    """Shape (S, B, 3), m."""
    covariance: FloatArray
    """All of a point's uncertainty, shape (S, B, 1) isotropic or (S, B, 9), m^2."""
    shared: FloatArray
    """The part of it that a point shares with its scan, shape (S, B, 9), or (1, 1, 1) when there is none."""
    valid: np.ndarray
    """Which points are returns, shape (S, B) bool."""
    labels: np.ndarray
    """Region of every point, shape (S, B) int64, -1 = none."""
    start: int = 0
    """First row that is to be labelled; those before it are settled and only show where regions reach in."""
    prior: FloatArray = field(default_factory=lambda: np.empty((0, ROW_SIZE)))
    """Moments of the points before `start`, of the regions that reach in, shape (P, 11)."""
    rows: FloatArray = field(default_factory=lambda: np.empty((0, ROW_SIZE)))
    """Moments of the regions, shape (R, 11); region r < P continues the prior one."""
    bias: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    """Variance along the normal that every region shares with its scans, m^2, and its mean scan, shape (R, 2)."""
    alias: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    """The region every region has been fused into, or itself, shape (R,)."""

    @property
    def fresh(self) -> slice:
        """The rows to be labelled."""
        return slice(self.start, None)

    @property
    def free(self) -> np.ndarray:
        """Returns that belong to no region, in the rows to be labelled, shape (S - start, B) bool."""
        return self.valid[self.fresh] & (self.labels[self.fresh] < 0)


def segment_sheet(sheet: Sheet, views: FloatArray, config: MapperConfig) -> None:
    """Label the fresh rows of a sheet in place."""
    quads = _filter(sheet, views, config)
    for repeat in range(ROUNDS):
        if repeat:
            release_misfits(sheet, config)
        size = config.largest_cell
        while size >= config.smallest_cell:
            join_cells(sheet, quads, size, config)
            size //= 2
        if len(sheet.rows):
            spread(sheet, views, config)
            drop_small(sheet, config)
    if len(sheet.rows):
        part_at_creases(sheet, views, config)


def _filter(sheet: Sheet, views: FloatArray, config: MapperConfig) -> np.ndarray:
    """The quads of the fresh rows that pass the edge test."""
    part, literal = sheet.fresh, config.literal_edge_test
    tangent, limit = float(np.tan(config.max_incidence_rad)), chdtri(3 if literal else 1, config.edge_significance)
    linked = links(sheet.points[part], sheet.covariance[part], sheet.valid[part], views[part], tangent, limit, literal)
    return surviving_quads(*linked)


def join_cells(sheet: Sheet, quads: np.ndarray, size: int, config: MapperConfig) -> None:
    """Find planar cells among the free points, fuse them with each other and with the regions."""
    floor, free = config.flatness_m**2, sheet.free
    points, covariance = sheet.points[sheet.fresh], sheet.covariance[sheet.fresh]
    moments = cells.cell_moments(points, covariance, free, size, floor)
    failed = cells.failed_quads(free, quads, size)
    planar = cells.planar_cells(moments, failed, free.shape, size, -ndtri(config.significance), CELL_SLACK)
    shared = sheet.shared[sheet.fresh] if len(sheet.shared) > 1 else sheet.shared
    if size > cells.STRIPS and len(shared) == 1:
        limit = CELL_SLACK * chdtri(1, config.significance / (2 * cells.STRIPS))
        cells.reject_steps(planar, points, covariance, moments, free, size, floor, limit)
    if not planar.any():
        return
    bias = cells.shared_variances(moments, shared, free, planar, size, sheet.start)
    n_regions = len(sheet.rows)
    node = np.where(planar, n_regions + np.cumsum(planar.ravel()).reshape(planar.shape) - 1, -1)
    nodes, biases = np.concatenate((sheet.rows, moments[planar])), np.concatenate((sheet.bias, bias))
    edges = cells.cell_edges(node, sheet.labels, sheet.start, size)
    root = _cluster(nodes, biases, edges, config)
    sheet.rows, sheet.bias = nodes[:n_regions], biases[:n_regions]
    _fuse(sheet, root[:n_regions])
    fresh = [r for r in np.unique(root) if r >= n_regions and is_determined(nodes[r], config)]
    label_of = np.full(len(nodes), -1, dtype=np.int64)
    label_of[:n_regions] = np.arange(n_regions)
    label_of[fresh] = n_regions + np.arange(len(fresh))
    _append(sheet, nodes[fresh], biases[fresh])
    cells.paint(sheet.labels[sheet.fresh], node, label_of[root], free, size)


def _cluster(rows: FloatArray, bias: FloatArray, edges: np.ndarray, config: MapperConfig) -> np.ndarray:
    known = not bias[:, 0].any()
    limits = chdtri(np.array([1, 3]), (STEP_SIGNIFICANCE, FUSE_SIGNIFICANCE) if known else config.significance)
    return cluster(rows, bias, edges, limits, config.flatness_m, max(config.pose_correlation_scans, 1.0))


def is_determined(row: FloatArray, config: MapperConfig) -> bool:
    """Whether the smaller of the two tilts is known to max_tilt_rad."""
    return eigenvalues(row)[1] * config.max_tilt_rad**2 >= 1.0


def _append(sheet: Sheet, rows: FloatArray, bias: FloatArray) -> None:
    """Add regions to a sheet."""
    first = len(sheet.rows)
    sheet.rows, sheet.bias = np.concatenate((sheet.rows, rows)), np.concatenate((sheet.bias, bias))
    sheet.prior = np.concatenate((sheet.prior, np.zeros((len(rows), ROW_SIZE))))
    sheet.alias = np.concatenate((sheet.alias, np.arange(first, first + len(rows))))


def _fuse(sheet: Sheet, root: np.ndarray) -> None:
    """Carry the result of a clustering of the regions over to labels and priors."""
    gone = np.flatnonzero(root != np.arange(len(root)))
    if not len(gone):
        return
    for r in gone:
        merge_rows(sheet.prior[root[r]], sheet.prior[r], sheet.prior[root[r]])
        sheet.prior[r] = 0.0
    sheet.alias = root[sheet.alias]
    sheet.labels[:] = np.append(root, -1)[sheet.labels]


def refit(sheet: Sheet, config: MapperConfig) -> None:
    """Moments of the regions from all of their points."""
    part = sheet.fresh
    sheet.rows = growing.fit_regions(
        sheet.points[part], sheet.covariance[part], sheet.labels[part], sheet.rows, sheet.prior, config.flatness_m**2
    )


def spread(sheet: Sheet, views: FloatArray, config: MapperConfig) -> None:
    """Grow regions to single points, fuse those that are one plane, settle borders."""
    _grow(sheet, config)
    refit(sheet, config)
    fuse_neighbours(sheet, views, 0, config)
    settle_borders(sheet, config)
    if dissolve_superfluous(sheet, config):
        refit(sheet, config)


def dissolve_superfluous(sheet: Sheet, config: MapperConfig) -> int:
    """Give the points of small regions that their neighbours explain as well to those; returns how many did."""
    planes = growing.hesse(sheet.rows)
    edges = _distinct(dissolving.near_pairs(sheet.labels, NEAR), len(sheet.rows))
    sizes = np.bincount(sheet.labels[sheet.labels >= 0], minlength=len(sheet.rows))
    return dissolving.dissolve(
        sheet.points, sheet.covariance, sheet.labels, sheet.start, sizes, edges, planes, config.flatness_m**2
    )


def _neighbours(sheet: Sheet, views: FloatArray, planes: FloatArray, gap: int, config: MapperConfig) -> np.ndarray:
    """Pairs of regions that meet, each once, shape (E, 2)."""
    tolerance = config.flatness_m**2 + sheet.bias[:, 0]
    pairs = growing.border_pairs(
        sheet.points, sheet.covariance, sheet.valid, views, sheet.labels, planes, tolerance, gap, HIDDEN
    )
    return _distinct(pairs, len(sheet.rows))


def _distinct(pairs: np.ndarray, n_regions: int) -> np.ndarray:
    """Each pair once, in ascending order, shape (E, 2)."""
    codes = distinct(pairs[:, 0] * n_regions + pairs[:, 1])
    return np.stack(np.divmod(codes, max(n_regions, 1)), axis=1)


def _grow(sheet: Sheet, config: MapperConfig) -> None:
    growing.grow(
        sheet.points,
        sheet.covariance,
        sheet.valid,
        sheet.labels,
        sheet.start,
        growing.hesse(sheet.rows),
        config.gate_sigma**2,
        config.flatness_m**2,
    )


def settle_borders(sheet: Sheet, config: MapperConfig) -> None:
    """Points at the borders of regions go where they fit best: block by block, then one by one."""
    floor, gate = config.flatness_m**2, config.gate_sigma**2
    for size in BORDER_BLOCKS:
        moved = borders.choose_blocks(
            sheet.points, sheet.covariance, sheet.labels, sheet.start, growing.hesse(sheet.rows), gate, floor, size
        )
        if moved:
            refit(sheet, config)
    planes = growing.hesse(sheet.rows)
    for _ in range(BORDER_SWEEPS):
        borders.choose_points(
            sheet.points,
            sheet.covariance,
            sheet.valid,
            sheet.labels,
            sheet.start,
            planes,
            gate,
            floor,
            config.border_smoothness,
        )
    refit(sheet, config)


def part_at_creases(sheet: Sheet, views: FloatArray, config: MapperConfig) -> None:
    """Cut regions where the surface bends, number their parts, rejoin those that only an occluder parts, heal."""
    creases.unlabel_creases(
        sheet.points,
        sheet.covariance,
        sheet.valid,
        sheet.labels,
        sheet.start,
        growing.hesse(sheet.rows),
        config.max_crease_rad,
        CREASE_CERTAINTY,
    )
    origin = creases.split_regions(sheet.labels, sheet.start, len(sheet.rows))
    _append(sheet, sheet.rows[origin], sheet.bias[origin])
    refit(sheet, config)
    drop_small(sheet, config)
    fuse_neighbours(sheet, views, BORDER_GAP, config)
    _grow(sheet, config)
    settle_borders(sheet, config)


def fuse_neighbours(sheet: Sheet, views: FloatArray, gap: int, config: MapperConfig) -> None:
    """Fuse regions that meet and are one plane (chi2)."""
    planes = growing.hesse(sheet.rows)
    sheet.bias = growing.shared_of_regions(sheet.shared, sheet.labels, planes)
    edges = _neighbours(sheet, views, planes, gap, config)
    if len(edges):
        _fuse(sheet, _cluster(sheet.rows, sheet.bias, edges, config))


def drop_small(sheet: Sheet, config: MapperConfig) -> None:
    """Take the points from regions that are too small or do not determine a plane; those from earlier scans stay."""
    keep = np.array([row[0] >= config.min_points and is_determined(row, config) for row in sheet.rows], dtype=bool)
    keep |= sheet.prior[:, 0] > 0.0
    if not keep.all():
        sheet.labels[~np.append(keep, True)[sheet.labels]] = -1


def release_misfits(sheet: Sheet, config: MapperConfig) -> None:
    """Take the points from their region where a whole cell of them lies off its plane: a board on a wall."""
    part = sheet.fresh
    growing.release(
        sheet.points[part],
        sheet.covariance[part],
        sheet.labels[part],
        growing.hesse(sheet.rows),
        config.flatness_m**2 + sheet.bias[:, 0],
        MISFIT_CELL,
        chdtri(1, MISFIT_SIGNIFICANCE),
    )
    if len(sheet.rows):
        refit(sheet, config)


def number_by_first_point(labels: np.ndarray, n_regions: int) -> tuple[np.ndarray, np.ndarray]:
    """Labels 0..K-1 in the order of the first point of each region, shape of labels, and the regions kept, (K,)."""
    flat = labels.ravel()
    used = np.flatnonzero(flat >= 0)
    first = np.full(n_regions, flat.size)
    np.minimum.at(first, flat[used], used)
    order = np.argsort(first, kind="stable")
    order = order[first[order] < flat.size]
    number = np.full(n_regions + 1, -1, dtype=np.int64)
    number[order] = np.arange(len(order))
    return number[labels], order
