"""From an organised grid of points to labelled regions: coarse cells first, single points last."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from spplanes._check import FloatArray
from spplanes.segmentation.clustering.joining import join_cells
from spplanes.segmentation.config import FEW_ROWS, MapperConfig
from spplanes.segmentation.quads import links, surviving_quads
from spplanes.segmentation.refinement.refining import part_at_creases, part_steps, release_misfits, spread
from spplanes.segmentation.sheet import Sheet, drop_small, refit

ROUNDS = 2
"""The search starts again, once, with the points that turned out not to fit."""


def segment_sheet(sheet: Sheet, views: FloatArray, config: MapperConfig) -> None:
    """Label the fresh rows of a sheet in place."""
    if len(sheet.points) >= FEW_ROWS or len(sheet.prior):
        _segment(sheet, views, config)
        return
    if np.count_nonzero(sheet.valid.any(axis=1)) < 2:
        return  # points of one scan lie on the scan's own plane, which is no surface
    wide, eyes = _stretched(sheet, views, FEW_ROWS / len(sheet.points))
    _segment(wide, eyes, config.for_rows(len(sheet.points)))
    sheet.rows, sheet.prior, sheet.bias, sheet.alias = wide.rows, wide.prior, wide.bias, wide.alias
    sheet.labels[:] = wide.labels
    for _ in range(2):
        refit(sheet, config)


def _stretched(sheet: Sheet, views: FloatArray, factor: float) -> tuple[Sheet, FloatArray]:
    """The same sheet and viewpoints, stretched along the mean step from row to row.

    Two scans are narrower than their noise is wide, and the least eigenvalue of such a strip lies along the step, not
    along its normal. An affine map takes planes to planes and leaves every chi2 as it is, covariances being mapped too;
    only what is taken for the normal of a strip changes.
    """
    both = sheet.valid[0] & sheet.valid[-1]
    step = (sheet.points[-1, both] - sheet.points[0, both]).mean(axis=0) if both.any() else np.zeros(3)
    length = np.linalg.norm(step)
    if length == 0.0:
        return replace(sheet, labels=sheet.labels.copy()), views
    step /= length
    matrix = np.eye(3) + (factor - 1.0) * np.outer(step, step)
    wide = replace(
        sheet,
        points=np.ascontiguousarray(sheet.points @ matrix),
        covariance=_mapped(sheet.covariance, matrix),
        shared=_mapped(sheet.shared, matrix) if len(sheet.shared) > 1 else sheet.shared,
        labels=sheet.labels.copy(),
    )
    return wide, views @ matrix


def _mapped(covariance: FloatArray, matrix: FloatArray) -> FloatArray:
    """Covariances (S, B, 1) or (S, B, 9) of mapped points, shape (S, B, 9)."""
    n_rows, n_cols, size = covariance.shape
    full = covariance * np.eye(3).ravel() if size == 1 else covariance
    mapped = matrix @ full.reshape(n_rows, n_cols, 3, 3) @ matrix.T
    return np.ascontiguousarray(mapped.reshape(n_rows, n_cols, 9))


def _segment(sheet: Sheet, views: FloatArray, config: MapperConfig) -> None:
    quads = _filter(sheet, views, config)
    for repeat in range(ROUNDS):
        if repeat:
            part_steps(sheet, config)
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
