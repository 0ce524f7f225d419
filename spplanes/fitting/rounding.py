"""What the rounding of coordinates leaves as an error that all points of a plane have in common.

Coordinates that are whole multiples of a step, of a file in centimetres say, are each off by up to half of it, with
variance q^2 = step^2 / 12. Where the true coordinate varies over the plane by much less than the step, because noise is
small and the plane lies across the axis, all points are off by the same. Where it varies, that averages out: of a
spread of variance v the first harmonic of the rounding error is left, q^2 exp(-4 pi^2 v / step^2).

The noise among what varies is only seen after rounding. Let r be the variance seen over step^2. Where two values are
seen, r = p (1 - p) with shares p and 1 - p, the mean may lie anywhere in a cell, and (1 - 4 r) q^2 is left; where more
are, r - 1/12 is the variance of the noise. The larger one is taken.

References:
    Widrow, Kollar, "Quantization Noise", Cambridge University Press 2008, for the harmonics.
"""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray


def with_rounding(
    covariances: FloatArray, noise: FloatArray, points: FloatArray, frames: FloatArray, seen: FloatArray
) -> FloatArray:
    """The covariances (P, 3, 3) with what rounded coordinates leave as a common error; as given without any. ``noise``
    are the same by the stated noise alone, ``seen`` (P,) the variances of the points about their planes, m^2."""
    steps = coordinate_steps(points)
    if not steps.any():
        return covariances
    common = _common_variances(steps, noise, frames, seen)
    some = common > 1e-6 * covariances[:, 0, 0]
    if not some.any():
        return covariances
    total = covariances.copy()
    total[some] += (common / noise[:, 0, 0])[some, None, None] * noise[some]  # as the fit of a single point's worth
    return total


def coordinate_steps(points: FloatArray) -> FloatArray:
    """What the coordinates of points (N, 3) are multiples of, up to an offset, along each axis, (3,), m; 0: of nothing.

    Five gaps tell a step: fewer may be multiples of the smallest by chance. An axis with fewer, that of a single wall,
    is taken to have the least step of the others, if its own values differ by multiples of it. Of these count the ones
    that the points extend over a hundred times: else a step may be that of a mesh.
    """
    every = -(-max(len(points), 1) // 4096)
    gaps = [_gaps(axis[np.isfinite(axis)]) for axis in points[::every].T]
    own = [_step(one, one.min()) if len(one) >= 5 else None for one in gaps]
    told = [step if one.sum() >= 100.0 * step else 0.0 for step, one in zip(own, gaps, strict=True) if step is not None]
    least = min(told, default=0.0)
    for axis in [k for k in range(3) if own[k] is None]:
        own[axis] = _step(gaps[axis], least) if least else 0.0
    return np.array(own, dtype=np.float64)


def _gaps(values: FloatArray) -> FloatArray:
    """Differences of successive distinct values, shape (M,); what is smaller than these is arithmetic."""
    gaps = np.diff(np.sort(values))
    return gaps[gaps > 1e-12 * np.abs(values).max(initial=0.0)]


def _step(gaps: FloatArray, about: float) -> float:
    """The step near ``about`` that all sums of successive gaps are whole multiples of, to 1 %, else 0."""
    counts = np.rint(gaps / about)
    step = float(gaps.sum() / counts.sum()) if counts.any() else about
    off = np.cumsum(gaps) - step * np.cumsum(counts)
    return step if np.abs(off).max(initial=0.0) < 0.01 * step else 0.0


def _common_variances(steps: FloatArray, noise: FloatArray, frames: FloatArray, seen: FloatArray) -> FloatArray:
    """Variance of the offset of every plane by the rounding that its points share, shape (P,), m^2."""
    rounded = steps > 0.0
    squares, axes = steps[rounded] ** 2, frames[:, :3, :3][:, rounded] ** 2
    variances = np.diagonal(noise, axis1=1, axis2=2)
    extents = variances[:, :1] / variances[:, 1:]  # of the points along x and y: information of a tilt is x^2
    spread = np.einsum("pij,pj->pi", axes[..., :2], extents) / squares
    scatter = axes[..., 2] * seen[:, None] / squares
    by_noise = np.exp(-4.0 * np.pi**2 * np.maximum(scatter - 1.0 / 12.0, 0.0))
    left = np.exp(-4.0 * np.pi**2 * spread) * np.maximum(1.0 - 4.0 * scatter, by_noise)
    return (axes[..., 2] * squares * left).sum(axis=1) / 12.0
