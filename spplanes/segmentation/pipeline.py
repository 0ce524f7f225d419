"""From an organised grid of points to labelled regions: coarse cells first, single points last."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import chdtri

from spplanes._check import FloatArray
from spplanes._jit import inlined, njit
from spplanes._rows import solve3
from spplanes._threads import in_parts
from spplanes.fitting._moment_patches import variance_along
from spplanes.segmentation.clustering.joining import join_cells
from spplanes.segmentation.config import FEW_ROWS, MapperConfig
from spplanes.segmentation.refinement.refining import part_at_creases, release_misfits, spread
from spplanes.segmentation.sheet import Sheet, drop_small, refit


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
    for repeat in range(2):  # again, once, with the points that turned out not to fit
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
    """The quads (i, j), (i, j+1), (i+1, j+1), (i+1, j) of the fresh rows all edges of which pass the test, (S-1, B-1):
    filter of Weingarten, Gruener, Siegwart, "Probabilistic Plane Fitting in 3D", ICRA 2004, section IV."""
    part, literal = sheet.fresh, config.literal_edge_test
    grid = sheet.points[part], sheet.covariance[part], sheet.valid[part]
    tangent, limit = float(np.tan(config.max_incidence_rad)), chdtri(3 if literal else 1, config.edge_significance)
    right, down = np.zeros((2, *grid[2].shape), dtype=np.bool_)
    link_rows = partial(_link_rows, grid, views[part], (tangent, limit, literal), (right, down))
    in_parts(link_rows, len(right), right.size)
    return right[:-1, :-1] & right[1:, :-1] & down[:-1, :-1] & down[:-1, 1:]


@inlined
def _jump_chi2(points, covariance, here, there, views, tangent):
    """Chi2 (1 dof) of the step in depth that no surface seen at less than the steepest incidence explains."""
    (i, j), (k, m) = here, there
    ax, ay, az = points[i, j, 0] - views[i, 0], points[i, j, 1] - views[i, 1], points[i, j, 2] - views[i, 2]
    ex, ey, ez = points[k, m, 0] - points[i, j, 0], points[k, m, 1] - points[i, j, 1], points[k, m, 2] - points[i, j, 2]
    range_sq, step_sq = ax * ax + ay * ay + az * az, ex * ex + ey * ey + ez * ez
    if range_sq == 0.0:
        return np.inf
    along = ex * ax + ey * ay + ez * az
    if (1.0 + tangent * tangent) * along * along <= tangent * tangent * step_sq * range_sq:
        return 0.0
    s = 1.0 / np.sqrt(range_sq)
    rest = abs(along) * s - tangent * np.sqrt(max(step_sq - along * along / range_sq, 0.0))
    ux, uy, uz = ax * s, ay * s, az * s
    variance = variance_along(covariance, i, j, ux, uy, uz) + variance_along(covariance, k, m, ux, uy, uz)
    return rest * rest / variance if variance > 0.0 else np.inf


@inlined
def _literal_chi2(points, covariance, i, j, k, m):
    """Chi2 (3 dof) of the whole displacement, the paper's test: (e_a - e_b)^T (C_a + C_b)^-1 (e_a - e_b)."""
    x, y, z = points[k, m, 0] - points[i, j, 0], points[k, m, 1] - points[i, j, 1], points[k, m, 2] - points[i, j, 2]
    c, d = covariance[i, j], covariance[k, m]
    if covariance.shape[2] == 1:
        return (x * x + y * y + z * z) / ((c[0] + d[0]) * (1.0 + 1e-9) + 1e-18)
    more = 1.0 + 1e-9
    xx, yy, zz = (c[0] + d[0]) * more + 1e-18, (c[4] + d[4]) * more + 1e-18, (c[8] + d[8]) * more + 1e-18
    solved = solve3((xx, c[1] + d[1], c[2] + d[2], yy, c[5] + d[5], zz), x, y, z)
    return x * solved[0] + y * solved[1] + z * solved[2]


@njit(cache=True)
def _link_rows(grid, views, rule, linked, first, last):
    """Whether points of the rows from first to last lie on one surface with their neighbours: to the right, below.
    `rule`: tangent of the steepest incidence at which a surface is still expected; largest chi2, of 1 degree of freedom
    or 3; whether to test the whole displacement, as the paper prints it, and not the jump in depth."""
    (points, covariance, valid), (tangent, limit, literal) = grid, rule
    n_rows, n_cols = valid.shape
    for i in range(first, last):
        for step in range(2 if i + 1 < n_rows else 1):
            for j in range(n_cols - 1 + step):
                k, m = i + step, j + 1 - step
                if not (valid[i, j] and valid[k, m]):
                    continue
                if literal:
                    chi2 = _literal_chi2(points, covariance, i, j, k, m)
                else:
                    chi2 = _jump_chi2(points, covariance, (i, j), (k, m), views, tangent)
                linked[step][i, j] = chi2 <= limit
