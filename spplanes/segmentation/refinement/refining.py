"""Refinement: regions grow to single points, superfluous ones dissolve, borders settle, bent surfaces part."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from spplanes._check import FloatArray
from spplanes.outlines._raster import distinct_pairs
from spplanes.segmentation.clustering import growing
from spplanes.segmentation.clustering.cells import STEP_SHARE
from spplanes.segmentation.clustering.joining import fuse_neighbours
from spplanes.segmentation.config import MapperConfig
from spplanes.segmentation.refinement import borders, creases, dissolving
from spplanes.segmentation.sheet import Sheet, append, drop_small, refit

BORDER_GAP = 12
"""Most points along a row or column that may be missing where a plane is taken to continue: a beam, a pole."""
MISFIT_CELL = 8
"""Side of the cells in which the points of a region are searched for a common offset from its plane."""
MISFIT_SIGNIFICANCE = 1e-4
"""Share of such cells that may be found by chance; there are many of them."""
STEADY_SCANS = 24
"""Scans over which the errors that they share must hang together for them to move a cell as they move its region."""
CREASE_CERTAINTY = 3.0
"""Standard deviations of a local normal by which a crease must exceed the angle allowed."""
SEAM_REACH = 3
"""Reach, points to each side, of the windows in which a seam is searched for."""
SEAM_SIGNIFICANCE = 1e-3
"""Share of such windows that may be found by chance."""
NEAR = 40
"""Points along a row or column within which a larger plane may explain a small region as well."""
BORDER_BLOCKS = (8, 8, 4)
"""Sides of the blocks of points that change sides together, sweep after sweep."""
BORDER_SWEEPS = 2
"""Sweeps over the points at borders; more change next to nothing."""


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
    edges = distinct_pairs(dissolving.near_pairs(sheet.labels, NEAR), len(sheet.rows))
    sizes = np.bincount(sheet.labels[sheet.labels >= 0], minlength=len(sheet.rows))
    smallest_first = np.argsort(sizes, kind="stable")
    return dissolving.dissolve(sheet.grid, sizes, smallest_first, edges, planes, config.flatness_m**2)


def _grow(sheet: Sheet, config: MapperConfig) -> None:
    growing.grow(sheet.grid, growing.hesse(sheet.rows), config.gate_sigma**2, config.flatness_m**2)


def settle_borders(sheet: Sheet, config: MapperConfig) -> None:
    """Points at the borders of regions go where they fit best: block by block, then one by one."""
    floor, gate = config.flatness_m**2, config.gate_sigma**2
    for size in BORDER_BLOCKS:
        moved = borders.choose_blocks(sheet.grid, growing.hesse(sheet.rows), gate, floor, size)
        if moved:
            refit(sheet, config)
    planes = growing.hesse(sheet.rows)
    for _ in range(BORDER_SWEEPS):
        borders.choose_points(sheet.grid, planes, gate, floor, config.border_smoothness)
    refit(sheet, config)


def part_at_creases(sheet: Sheet, views: FloatArray, config: MapperConfig) -> None:
    """Cut regions where the surface bends, number their parts, rejoin those that only an occluder parts, heal."""
    planes = growing.hesse(sheet.rows)
    creases.unlabel_creases(sheet.grid, planes, config.max_crease_rad, CREASE_CERTAINTY)
    tolerance, limit = STEP_SHARE * config.flatness_m**2 + sheet.bias[:, 0], float(chdtri(1, SEAM_SIGNIFICANCE))
    creases.unlabel_seams(sheet.grid, views, planes, tolerance, float(config.flatness_m), SEAM_REACH, limit)
    origin = creases.split_regions(sheet.labels, sheet.start, len(sheet.rows))
    append(sheet, sheet.rows[origin], sheet.bias[origin])
    refit(sheet, config)
    drop_small(sheet, config)
    fuse_neighbours(sheet, views, BORDER_GAP, config)
    _grow(sheet, config)
    settle_borders(sheet, config)


def release_misfits(sheet: Sheet, config: MapperConfig) -> None:
    """Take the points from their region where a whole cell of them lies off its plane: a board on a wall.

    What the points of a region share with their scans may move a cell of it too, unless it moves the others alike: such
    errors widen all tests by which regions fuse, but they cancel in the step between surfaces seen in the same scans.
    """
    part, steady = sheet.fresh, config.pose_correlation_scans >= STEADY_SCANS
    growing.release(
        sheet.points[part],
        sheet.covariance[part],
        sheet.labels[part],
        growing.hesse(sheet.rows),
        config.flatness_m**2 + (0.0 if steady else 1.0) * sheet.bias[:, 0],
        MISFIT_CELL,
        chdtri(1, MISFIT_SIGNIFICANCE),
    )
    if len(sheet.rows):
        refit(sheet, config)
