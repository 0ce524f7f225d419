"""Grids of few rows: drawn out across their rows, so that noise does not hide which way their strips lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spplanes._check import FloatArray
from spplanes.segmentation.sheet import Sheet


def stretched(sheet: Sheet, views: FloatArray, factor: float) -> tuple[Sheet, FloatArray]:
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
