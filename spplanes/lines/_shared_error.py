"""What beams side by side on a wall err by together: found in the residuals of all lines of a scan.

The mechanism is that of planes (`spplanes.fitting.shared_error`): a line is a plane whose points have no height.
"""

from __future__ import annotations

import numpy as np

from spplanes._check import FloatArray
from spplanes.fitting.shared_error import shared_error_of

#: Variance of the tilt that beams of no height leave open, in that of the shift, 1 / m^2.
_OPEN = 1e12
#: Share of a variance below which what is left of it when a larger part is taken off is rounding.
_ROUNDED = 1e-9


def with_shared_error(
    rows: FloatArray,
    support: np.ndarray,
    counts: np.ndarray,
    ranges: FloatArray,
    angles: FloatArray,
    sigmas: FloatArray,
    bearing_sigma: float,
    flatness: float,
) -> FloatArray:
    """Covariances of (alpha, rho) of lines with the noise and the shared error that residuals show, shape (M, 2, 2).

    What is stated is a lower bound: the noise by `sigmas` and `bearing_sigma`, the shared error by `flatness`.

    Args:
        rows: the lines, shape (M, 12), see `extract`.
        support: the beams on them, one line after the other, shape (N,).
        counts: of each line, shape (M,).
        ranges, angles, sigmas: of the scan, shape (B,).
        bearing_sigma, flatness: as stated, see `LineConfig`.
    """
    alpha, rho = rows[:, 0], rows[:, 1]
    stated = rows[:, 4:8].reshape(-1, 2, 2)
    line = np.repeat(np.arange(len(rows)), counts)
    turn = angles[support] - alpha[line]
    cosine, along = np.cos(turn), rho[line] * np.tan(turn)
    ends = np.cumsum(counts)
    length = np.abs(along[ends - 1] - along[ends - counts])
    # about the point where shift and direction are uncorrelated: z = d rho - middle d alpha, theta = d alpha
    uneven = np.stack((np.full(len(rows), flatness**2), 12.0 * (flatness / length) ** 2), axis=-1)
    middle = stated[:, 0, 1] / stated[:, 0, 0]
    to_sp = np.zeros((len(rows), 2, 2))
    to_sp[:, 0, 0], to_sp[:, 0, 1], to_sp[:, 1, 0] = -middle, 1.0, 1.0
    noise = to_sp @ stated @ np.swapaxes(to_sp, 1, 2)
    whole = noise[:, (0, 1), (0, 1)]
    noise[:, (0, 1), (0, 1)] = np.maximum(whole - uneven, _ROUNDED * whole)
    covariances = np.zeros((len(rows), 3, 3))
    covariances[:, :2, :2] = noise
    covariances[:, 2, 2] = _OPEN * noise[:, 0, 0]
    points = np.zeros((len(support), 3))
    points[:, 0], points[:, 2] = along - middle[line], ranges[support] * cosine - rho[line]
    variances = (sigmas[support] * cosine) ** 2 + (bearing_sigma * along) ** 2
    found = shared_error_of(
        points, variances[:, None], line, np.tile(np.eye(4), (len(rows), 1, 1)), covariances, stated=True
    )
    total = found.covariances[:, :2, :2]
    shared = total - found.noise_factors[:, None, None] * noise
    total[:, (0, 1), (0, 1)] += np.maximum(uneven - shared[:, (0, 1), (0, 1)], 0.0)
    from_sp = np.linalg.inv(to_sp)
    result = from_sp @ total @ np.swapaxes(from_sp, 1, 2)
    return 0.5 * (result + np.swapaxes(result, 1, 2))
