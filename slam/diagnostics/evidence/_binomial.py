"""The tail of the binomial distribution; `scipy.stats`, which has it, would take 0.7 s of every command."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import betainc

from spplanes._check import FloatArray


def at_least(successes: ArrayLike, trials: ArrayLike, share: float = 0.5) -> FloatArray:
    """Probability of so many successes or more of so many trials, each of probability ``share``; shapes broadcast."""
    k, n = np.broadcast_arrays(np.asarray(successes, dtype=float), np.asarray(trials, dtype=float))
    inside = (k > 0) & (k <= n)
    tail = betainc(np.where(inside, k, 1.0), np.where(inside, n - k + 1.0, 1.0), share)
    return np.where(inside, tail, np.where(k <= 0, 1.0, 0.0))
