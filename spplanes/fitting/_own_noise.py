"""Planes from moments whose points err along slanted beams, freed from what that noise adds to the scatter.

The scatter S = sum w (p - c)(p - c)^T of points with covariances C_i is expected to be that of the true points plus
V = sum w C_i. V is no multiple of the identity: its part that couples the normal with the plane turns the least
eigenvector of S, the more the steeper the beams. S - V has the true normal for its eigenvector. V needs no points once
they are added, and that of a union is the sum: planes stay honest in constant memory.

References:
    Van Huffel, Vandewalle, "The Total Least Squares Problem", SIAM 1991, chapter 8 (known error covariance).
"""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes._jit import njit
from spplanes._rows import row_frame, symmetric3
from spplanes.fitting._kernels import MAX_NOISE_SHARE
from spplanes.fitting._moment_patches import variance_from


@njit(cache=True)
def add_noise(covariance, labels, planes, total):
    """Add w C, w = 1 / (n^T C n), of every labelled point of a grid to V (R, 6), (xx, xy, xz, yy, yz, zz), of its
    region."""
    for i in range(labels.shape[0]):
        for j in range(labels.shape[1]):
            r = labels[i, j]
            if r >= 0:
                w = 1.0 / variance_from(covariance, i, j, planes, r)
                for k, of_nine in enumerate((0, 1, 2, 4, 5, 8)):
                    total[r, k] += w * covariance[i, j, of_nine]


def unbiased_frame(row: FloatArray, noise: FloatArray, eye: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Plane of moments (11,) and of the noise V (6,) in them, its normal to ``eye``, (3,), or d >= 0 where that is NaN.

    At most so much of V is taken out as the points scatter along the normal: noise that was stated too large does not
    turn the normal the other way. Given back are world_T_plane, W and the sums of w x^2 and w y^2 of the points without
    their noise, and the covariance of (z, theta, psi), without shared errors.
    """
    frame, values, clean = np.empty((4, 4)), np.empty(3), row.copy()
    row_frame(row, eye, frame, values)
    share = 0.0
    for _ in range(4):  # the share that is taken out depends on the normal, and the normal on it
        share = _share(row, noise, frame)
        clean[5:] = row[5:] - share * noise
        row_frame(clean, eye, frame, values)
    spread = np.array([row[1], values[2], values[1]])
    gain = np.diag([-1.0, 1.0]) @ frame[:3, :2].T
    covariance = np.diag(1.0 / spread)
    covariance[1:, 1:] += share * (gain @ symmetric3(noise) @ gain.T) / np.outer(spread[1:], spread[1:])
    return frame, spread, covariance


def _share(row: FloatArray, noise: FloatArray, frame: FloatArray) -> float:
    """Share of V in the scatter: what the points show along the normal, and no more than their extent allows."""
    scatter, added = (frame[:3, :3].T @ symmetric3(six) @ frame[:3, :3] for six in (row[5:], noise))
    if not added[2, 2] > 0.0:
        return 0.0
    widest = float(np.linalg.eigvals(np.linalg.solve(scatter[:2, :2], added[:2, :2])).real.max())
    share = min(1.0 - 1.0 / row[0], scatter[2, 2] / added[2, 2])
    return min(share, MAX_NOISE_SHARE / widest) if widest > 0.0 else share
