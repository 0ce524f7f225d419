"""The binomial tail is that of SciPy's distribution, to the bit."""

from __future__ import annotations

import numpy as np
from scipy.stats import binom

from slam.diagnostics.verdict import at_least


def test_it_is_the_survival_function_of_scipy():
    rng = np.random.default_rng(0)
    trials = rng.integers(0, 3000, 5000)
    successes = (rng.random(5000) * (trials + 2)).astype(int)
    for share in (0.001, 0.05, 0.5):
        assert np.array_equal(at_least(successes, trials, share), binom.sf(successes - 1, trials, share))
