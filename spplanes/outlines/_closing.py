"""Rasters made one part: pinches filled, gaps between parts closed."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from spplanes._jit import njit

#: Parts of one region that lie apart are bridged by closing the raster with up to this many cells.
BRIDGES = (1, 2, 4, 8, 16)


def one_part(filled: np.ndarray) -> np.ndarray:
    """The raster without pinches and in one part: closed as far as it takes, or else its largest part.

    Args:
        filled: shape (I, J) bool with an empty frame around it; something is filled. Pinches are filled in place.
    """
    fill_pinches(filled)
    parts, count = ndimage.label(filled)  # type: ignore[misc]
    if count == 1:
        return filled
    for reach in BRIDGES:
        whole = closed(filled, reach)
        fill_pinches(whole)
        if ndimage.label(whole)[1] == 1:  # type: ignore[misc]
            return whole
    return parts == 1 + np.bincount(parts[filled])[1:].argmax()


def closed(filled: np.ndarray, reach: int) -> np.ndarray:
    """Closing by a square that reaches so many cells to each side."""
    side, shape = 2 * reach + 1, np.array(filled.shape)
    wide = np.zeros(shape + 2 * reach, dtype=np.uint8)
    wide[reach:-reach, reach:-reach] = filled
    dilated = ndimage.maximum_filter(wide, side, mode="constant")
    return ndimage.minimum_filter(dilated, side, mode="constant")[reach:-reach, reach:-reach].astype(bool)


@njit(cache=True)
def fill_pinches(filled):
    """Fill a cell beside every two that touch at a corner only, in place, so that no ring meets itself."""
    n_i, n_j = filled.shape
    changed = True
    while changed:
        changed = False
        for i in range(1, n_i - 2):
            pinches = 0
            for j in range(1, n_j - 2):  # whole rows at once, which the compiler vectorises: hardly any has one
                a, b, c, d = filled[i, j], filled[i, j + 1], filled[i + 1, j], filled[i + 1, j + 1]
                pinches += (a != b) & (a != c) & (b != d)
            for j in range(1, n_j - 2 if pinches else 1):
                a, b, c, d = filled[i, j], filled[i, j + 1], filled[i + 1, j], filled[i + 1, j + 1]
                if a == d and b == c and a != b:
                    if a:
                        filled[i, j + 1] = True
                    else:
                        filled[i, j] = True
                    changed = True
