"""The binomial tail is that of SciPy's distribution, to the bit."""

from __future__ import annotations

import numpy as np
from scipy.stats import binom, binomtest

from slam.diagnostics.verdict import at_least


def test_it_is_the_survival_function_of_scipy():
    rng = np.random.default_rng(0)
    trials = rng.integers(0, 3000, 5000)
    successes = (rng.random(5000) * (trials + 2)).astype(int)
    for share in (0.001, 0.05, 0.5):
        assert np.array_equal(at_least(successes, trials, share), binom.sf(successes - 1, trials, share))


def test_it_counts_coins():
    assert at_least(2, 2) == 0.25 and at_least(1, 2) == 0.75 and at_least(0, 2) == 1.0 and at_least(3, 2) == 0.0
    assert at_least(0, 0) == 1.0
    assert at_least(7, 9) == binomtest(7, 9, alternative="greater").pvalue
