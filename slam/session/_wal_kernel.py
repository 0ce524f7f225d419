"""The checksum of SQLite's journal."""

from __future__ import annotations

import numpy as np

from spplanes._jit import njit


def checksum(data: bytes, order: str, first: int, second: int) -> tuple[int, int]:
    """Checksum of words of 32 bits in an order ("<" or ">"), going on from that of what is before them."""
    words = np.frombuffer(data, dtype=f"{order}u4").astype(np.uint32)
    sums = _add(words, np.uint32(first), np.uint32(second))
    return int(sums[0]), int(sums[1])


@njit(cache=True)
def _add(words, first, second):
    for i in range(0, len(words), 2):
        first = np.uint32(first + words[i] + second)
        second = np.uint32(second + words[i + 1] + first)
    return first, second
