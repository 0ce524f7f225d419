"""Noise estimation: how much a scanner's ranges scatter, read off a cloud, for sensors nobody describes."""

from __future__ import annotations

import numpy as np
from scipy.special import chdtri

from spplanes._check import FloatArray


def misses_of(grid: FloatArray, lag: int = 1, *, closed: bool = False) -> FloatArray:
    """How far the middle of three beams in a row lies from the plane through the outer two, shape (S, B - 2 lag), m.

    On a plane, inverse ranges of three beams a, b and c in a row are linear in the sines of the angles between them,
    sin(ac) / r_b = sin(bc) / r_a + sin(ab) / r_c, whatever the plane. What b misses that by is the noise of three
    beams; it is scaled to that of one. NaN where the three are not all there, not evenly spaced (by chords, to 2.5
    times), or not at similar ranges (to 5 %: one surface, not an edge). In closed rows the first beam follows the last;
    then there is a value for every beam, shape (S, B).
    """
    inside = slice(None) if closed else slice(lag, max(grid.shape[1] - lag, lag))
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        ranges = np.sqrt(_squares(grid))
        rays = grid / ranges[..., None]
        a, b, c = (np.roll(ranges, k, axis=1)[:, inside] for k in (lag, 0, -lag))
        # of the angle under a chord d between rays, sin = d sqrt(1 - d^2 / 4) and cos = 1 - d^2 / 2
        ab, bc = (_squares(rays - np.roll(rays, k, axis=1))[:, inside] for k in (lag, -lag))
        sin_ab, sin_bc = np.sqrt(ab * (1.0 - 0.25 * ab)), np.sqrt(bc * (1.0 - 0.25 * bc))
        whole = sin_ab * (1.0 - 0.5 * bc) + (1.0 - 0.5 * ab) * sin_bc
        expected = whole / (sin_bc / a + sin_ab / c)
        slope_a, slope_c = expected**2 * sin_bc / (whole * a**2), expected**2 * sin_ab / (whole * c**2)
        missed = (b - expected) / np.sqrt(1.0 + slope_a**2 + slope_c**2)
        near = np.maximum(np.abs(a - b), np.abs(c - b)) < 0.05 * b
        even = np.maximum(ab, bc) < 2.5**2 * np.minimum(ab, bc)
    return np.where(near & even & (ab > 0.0) & (bc > 0.0) & (ab < 4.0) & (bc < 4.0), missed, np.nan)


def scatter_along_beams(points: FloatArray, eyes: FloatArray, labels: np.ndarray, planes: FloatArray) -> bool:
    """Whether points scatter about their planes as by noise along beams from their eyes, not as if alike everywhere.

    Along beams their squares go with sin^2 of the angle at which the plane is met, whatever else goes with the range.
    The two are compared by logarithms of squares, in which outliers count little. Points and eyes are (N, 3), m, labels
    (N,), -1 = none, planes (normal, d), (R, 4).
    """
    on = labels >= 0
    if not on.any():
        return False
    normals, d, beams = planes[labels[on], :3], planes[labels[on], 3], points[on] - eyes[on]
    ranges = np.linalg.norm(beams, axis=1)
    sines = np.abs((normals * beams).sum(axis=1)) / ranges
    off = np.abs((normals * points[on]).sum(axis=1) - d)
    squares = 2.0 * np.log(np.maximum(off, 1e-6))  # logarithms of zero tell nothing
    by_range = np.vander(np.log(ranges), 3)
    beyond = squares - 2.0 * np.log(np.maximum(sines, 0.1))  # beams that graze a plane tell nothing of their noise
    beyond = beyond - by_range @ np.linalg.lstsq(by_range, beyond, rcond=None)[0]
    gain = ((squares - squares.mean()) ** 2).sum() - (beyond**2).sum()
    log_variance = 0.5 * np.pi**2  # of a chi2 of one dof
    return bool(gain > log_variance * chdtri(by_range.shape[1], 1e-6))


def _squares(vectors: FloatArray) -> FloatArray:
    """Squared lengths of vectors (..., 3), shape (...)."""
    return vectors[..., 0] ** 2 + vectors[..., 1] ** 2 + vectors[..., 2] ** 2
