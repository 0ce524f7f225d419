"""Range warp: ranges of a camera that are false by a smooth pattern of its image.

References:
    Herrera, Kannala, Heikkila, "Joint depth and color camera calibration with distortion correction", TPAMI 2012.
    Teichman, Miller, Thrun, "Unsupervised intrinsic calibration of depth sensors via SLAM", RSS 2013.
"""

from __future__ import annotations

import numpy as np
from pydantic import model_validator

from slam.sensors.mount import Finite, Frozen
from spplanes._check import FloatArray

#: Rows of weights, one for each wave down the image, of as many waves across it.
Waves = tuple[tuple[Finite, ...], ...]


class RangeWarp(Frozen):
    """By what share ranges are too long, as sums of cosines over the image.

    At row v and column u of an image of H by W pixels the share is a(v, u) + b(v, u) r for the range r, with
    a = sum_ij shares[i][j] cos(pi i (v + 1/2) / H) cos(pi j (u + 1/2) / W), and b alike.
    """

    shares: Waves
    """Weights of the waves of a, of one."""
    shares_per_m: Waves
    """Of those of b, which grow with the range, 1/m; as many."""

    @model_validator(mode="after")
    def _check_shape(self) -> RangeWarp:
        if len(self.shares) != len(self.shares_per_m):
            raise ValueError("expected as many rows of shares_per_m as of shares")
        if len({len(row) for row in (*self.shares, *self.shares_per_m)}) != 1:
            raise ValueError("expected rows of one length")
        return self

    def over(self, height: int, width: int) -> FloatArray:
        """a and b over an image, shape (2, H, W)."""
        weights = np.array((self.shares, self.shares_per_m), dtype=np.float64)
        down, across = waves(height, weights.shape[1]), waves(width, weights.shape[2])
        return np.asarray(down @ weights @ across.T, dtype=np.float64)

    def taken_off(self, points: FloatArray) -> FloatArray:
        """Points (H, W, 3) of an image, in the camera's frame, with true ranges."""
        share, per_m = self.over(*points.shape[:2])
        ranges = np.sqrt(np.einsum("hwi,hwi->hw", points, points))
        return points / (1.0 + share + per_m * ranges)[..., None]


def waves(size: int, count: int) -> FloatArray:
    """The first cosines over so many pixels, shape (size, count)."""
    return np.cos(np.pi / size * np.outer(np.arange(size) + 0.5, np.arange(count)))
