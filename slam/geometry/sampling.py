"""Samples of long runs: the same ones each time."""

from __future__ import annotations

import numpy as np


def evenly(count: int, most: int) -> list[int]:
    """Indices of at most so many of `count` elements, evenly over all of them: the sample of a long run is as good."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
