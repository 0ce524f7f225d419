"""How much a scanner's ranges scatter, read off a cloud: for sensors that nobody describes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spplanes._check import FloatArray

#: Fewer triples of neighbours than this say nothing.
_MIN_TRIPLES = 100
#: Neighbours lie within this share of each other's range: one surface, not an edge.
_SAME_SURFACE = 0.05
#: Distances between the three beams that are looked at, and the widest angle between two of them, rad.
_LAGS, _WIDEST_RAD = (1, 2, 4, 8), 0.06
#: A normal deviate lies within this many standard deviations half of the time.
_MEDIAN = 0.6744897501960817


@dataclass(frozen=True)
class Scatter:
    """How far ranges lie from planes through their neighbours."""

    beam_m: float
    """Standard deviation between beams next to each other, m: what each has of its own."""
    surface_m: float
    """The largest over beams up to some degrees apart, m: with what neighbours share, uneven surfaces and slow errors.
    """


def scatter_of(grid: FloatArray) -> Scatter | None:
    """Scatter of the ranges of a grid of points (S, B, 3) round its sensor; None where too little is seen."""
    sigmas = []
    for lag in _LAGS:
        wide = lag > 1 and _median_step(grid) * lag > _WIDEST_RAD
        sigma = None if wide else range_sigma_of(grid, lag)
        if sigma is not None:
            sigmas.append(sigma)
    return Scatter(sigmas[0], max(sigmas)) if sigmas else None


def range_sigma_of(grid: FloatArray, lag: int = 1) -> float | None:
    """Standard deviation of the ranges of a grid of points round its sensor, m; None where too little is seen.

    The median over all triples does not see edges and clutter, as long as most of the scan is smooth. Curved surfaces
    and steps of the ranges count as noise.

    Args:
        grid: shape (S, B, 3), m, in the sensor's frame; NaN = no return.
        lag: how many beams the three lie apart.
    """
    missed = misses_of(grid, lag)
    missed = missed[np.isfinite(missed)]
    return float(np.median(np.abs(missed))) / _MEDIAN if len(missed) >= _MIN_TRIPLES else None


def misses_of(grid: FloatArray, lag: int = 1) -> FloatArray:
    """How far the middle of three beams in a row lies from the plane through the outer two, shape (S, B - 2 lag), m.

    On a plane, inverse ranges of three beams a, b and c in a row are linear in the sines of the angles between them,
    sin(ac) / r_b = sin(bc) / r_a + sin(ab) / r_c, whatever the plane. What b misses that by is the noise of three
    beams; it is scaled to that of one. NaN where the three are not all there, not evenly spaced, or not at similar
    ranges.
    """
    ranges = np.linalg.norm(grid, axis=-1)
    first, middle, last = np.s_[:, : -2 * lag], np.s_[:, lag:-lag], np.s_[:, 2 * lag :]
    with np.errstate(invalid="ignore", divide="ignore"):
        rays = grid / ranges[..., None]
        a, b, c = ranges[first], ranges[middle], ranges[last]
        ab, bc = _angle(rays[first], rays[middle]), _angle(rays[middle], rays[last])
        whole = np.sin(ab + bc)
        expected = whole / (np.sin(bc) / a + np.sin(ab) / c)
        slope_a, slope_c = expected**2 * np.sin(bc) / (whole * a**2), expected**2 * np.sin(ab) / (whole * c**2)
        missed = (b - expected) / np.sqrt(1.0 + slope_a**2 + slope_c**2)
        near = np.maximum(np.abs(a - b), np.abs(c - b)) < _SAME_SURFACE * b
        even = (ab > 0.0) & (bc > 0.0) & (np.maximum(ab, bc) < 2.5 * np.minimum(ab, bc))
    return np.where(near & even, missed, np.nan)


def _median_step(grid: FloatArray) -> float:
    """Angle between neighbours in a row, rad."""
    with np.errstate(invalid="ignore", divide="ignore"):
        rays = grid / np.linalg.norm(grid, axis=-1, keepdims=True)
    steps = _angle(rays[:, :-1], rays[:, 1:])
    return float(np.median(steps[np.isfinite(steps)])) if np.isfinite(steps).any() else np.inf


def _angle(one: FloatArray, other: FloatArray) -> FloatArray:
    """Angle between unit vectors (..., 3), rad, exact for small ones too."""
    return 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(one - other, axis=-1), 0.0, 1.0))
