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


def spread(sheet: Sheet, views: FloatArray, config: MapperConfig) -> None:
    """Grow regions to single points, fuse those that are one plane, settle borders; the points of small regions that
    larger ones within 40 points explain as well go to those."""
    _grow(sheet, config)
    refit(sheet, config)
    fuse_neighbours(sheet, views, 0, config)
    settle_borders(sheet, config)
    edges = distinct_pairs(dissolving.near_pairs(sheet.labels, 40), len(sheet.rows))
    sizes = np.bincount(sheet.labels[sheet.labels >= 0], minlength=len(sheet.rows))
    smallest_first, planes = np.argsort(sizes, kind="stable"), growing.hesse(sheet.rows)
    if dissolving.dissolve(sheet.grid, sizes, smallest_first, edges, planes, config.flatness_m**2):
        refit(sheet, config)


def _grow(sheet: Sheet, config: MapperConfig) -> None:
    growing.grow(sheet.grid, growing.hesse(sheet.rows), config.gate_sigma**2, config.flatness_m**2)


def settle_borders(sheet: Sheet, config: MapperConfig) -> None:
    """Points at the borders of regions go where they fit best: block by block, then one by one."""
    floor, gate = config.flatness_m**2, config.gate_sigma**2
    for size in (8, 8, 4):
        moved = borders.choose_blocks(sheet.grid, growing.hesse(sheet.rows), gate, floor, size)
        if moved:
            refit(sheet, config)
    planes = growing.hesse(sheet.rows)
    for _ in range(2):  # more change next to nothing
        borders.choose_points(sheet.grid, planes, gate, floor, config.border_smoothness)
    refit(sheet, config)


def part_at_creases(sheet: Sheet, views: FloatArray, config: MapperConfig) -> None:
    """Cut regions where the surface bends, number their parts, rejoin those that only an occluder parts, heal."""
    planes = growing.hesse(sheet.rows)
    creases.unlabel_creases(sheet.grid, planes, config.max_crease_rad, 3.0)
    tolerance = STEP_SHARE * config.flatness_m**2 + sheet.bias[:, 0]
    creases.unlabel_seams(sheet.grid, views, planes, tolerance, float(config.flatness_m), 3, float(chdtri(1, 1e-3)))
    origin = creases.split_regions(sheet.labels, sheet.start, len(sheet.rows))
    append(sheet, sheet.rows[origin], sheet.bias[origin])
    refit(sheet, config)
    drop_small(sheet, config)
    fuse_neighbours(sheet, views, BORDER_GAP, config)
    _grow(sheet, config)
    settle_borders(sheet, config)


def release_misfits(sheet: Sheet, config: MapperConfig) -> None:
    """Take the points from their region where a whole cell of them lies off its plane: a board on a wall.

    What the points of a region share with their scans may move a cell of it too, unless it hangs together over 24 scans
    and moves the others alike: such errors widen all tests by which regions fuse, but they cancel in the step between
    surfaces seen in the same scans. There are many cells: 1e-4 of them may be found by chance.
    """
    part, steady = sheet.fresh, config.pose_correlation_scans >= 24
    grid, planes = (sheet.points[part], sheet.covariance[part], sheet.labels[part]), growing.hesse(sheet.rows)
    bias = config.flatness_m**2 + (0.0 if steady else 1.0) * sheet.bias[:, 0]
    growing.release(grid, planes, bias, 8, chdtri(1, 1e-4))
    if len(sheet.rows):
        refit(sheet, config)
