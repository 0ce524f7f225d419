"""Rasters made one part: pinches filled, gaps between parts closed."""

from __future__ import annotations

import numpy as np

from spplanes._jit import inlined, inner, njit

#: Parts of one region that lie apart are bridged by closing the raster with up to this many cells.
BRIDGES = (1, 2, 4, 8, 16)


def one_part(filled: np.ndarray) -> np.ndarray:
    """The raster without pinches and in one part: closed as far as it takes, or else its largest part.

    Args:
        filled: shape (I, J) bool with an empty frame around it; something is filled. Pinches are filled in place.
    """
    fill_pinches(filled)
    if count_parts(filled) == 1:
        return filled
    for reach in BRIDGES:
        whole = closed(filled, reach)
        fill_pinches(whole)
        if count_parts(whole) == 1:
            return whole
    return _largest_part(filled)


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


@njit(cache=True)
def closed(filled, reach):
    """Closing by a square that reaches up to 31 cells to each side; 64 cells at a time, as bits of words."""
    n_i, n_j = filled.shape
    words = np.zeros((n_i + 4 * reach, (n_j + 4 * reach) // 64 + 2), dtype=np.uint64)
    for i in range(n_i):
        for j in range(n_j):
            if filled[i, j]:
                place = j + 2 * reach
                words[i + 2 * reach, place >> 6] |= np.uint64(1) << np.uint64(place & 63)
    _any_in_window(words, 2 * reach + 1)
    _complement(words)
    _any_in_window(words[: n_i + 2 * reach], 2 * reach + 1)
    result = np.empty((n_i, n_j), dtype=np.bool_)
    for i in range(n_i):
        for j in range(n_j):
            result[i, j] = not (words[i, j >> 6] >> np.uint64(j & 63)) & np.uint64(1)
    return result


@inlined
def _complement(words):
    for i in range(words.shape[0]):
        for k in range(words.shape[1]):
            words[i, k] = ~words[i, k]


@inner(cache=True)
def _any_in_window(words, width):
    """Set every bit where the square of so many cells to a side that begins there has one that is set; in place.

    Squares grow to twice their size at a time. Where they leave the words, the answer is void.
    """
    have, last = 1, words.shape[1] - 1
    while have < width:
        step = min(have, width - have)
        down, up = np.uint64(step), np.uint64(64 - step)
        for i in range(words.shape[0] - step):
            here = words[i, 0] | words[i + step, 0]
            for k in range(last):
                beside = words[i, k + 1] | words[i + step, k + 1]
                words[i, k] = here | (here >> down) | (beside << up)
                here = beside
            words[i, last] = here | (here >> down)
        have += step


@njit(cache=True)
def count_parts(filled):
    """Number of 4-connected parts: runs of cells along rows that meet runs of the row before."""
    n_i, n_j = filled.shape
    n_runs = 0
    for i in range(n_i):
        for j in range(1, n_j):
            n_runs += filled[i, j] & (filled[i, j] ^ filled[i, j - 1])
    parent, begin, end = np.empty((3, n_runs), dtype=np.int64)
    count, before, n_parts = 0, 0, n_runs
    for i in range(n_i):
        above, before, j = before, count, 0
        last = before
        while j < n_j:
            if not filled[i, j]:
                j += 1
                continue
            parent[count], begin[count] = count, j
            while filled[i, j]:
                j += 1
            end[count] = j
            while above < last and end[above] <= begin[count]:
                above += 1
            for other in range(above, last):
                if begin[other] >= j:
                    break
                a, b = _root(parent, other), _root(parent, count)
                parent[max(a, b)] = min(a, b)
                n_parts -= a != b
            count += 1
    return n_parts


@inlined
def _root(parent, k):
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


def _largest_part(filled: np.ndarray) -> np.ndarray:
    """The largest 4-connected part, of several the first."""
    from scipy import ndimage

    parts, _ = ndimage.label(filled)  # type: ignore[misc]
    return parts == 1 + np.bincount(parts[filled])[1:].argmax()
