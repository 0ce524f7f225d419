"""The arithmetic by which observations are told apart, against numpy and scipy."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2 as chi2_distribution

from slam.association import Candidate, _chi2_and_log_det


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_chi2_and_log_det_are_those_of_numpy(size: int):
    rng = np.random.default_rng(size)
    for scale in (1e-6, 1.0, 1e6):
        root = scale * rng.normal(size=(size, size))
        covariance, residual = root @ root.T + np.eye(size), rng.normal(size=size)
        chi2, log_det = _chi2_and_log_det(residual.tolist(), covariance.tolist())
        assert np.isclose(chi2, residual @ np.linalg.solve(covariance, residual), rtol=1e-6)
        assert np.isclose(log_det, np.linalg.slogdet(2.0 * np.pi * covariance)[1], rtol=1e-9)


@pytest.mark.parametrize("dof", [1, 2, 3, 6])
@pytest.mark.parametrize("chi2", [0.0, 1e-12, 1.0, 30.0, 1e4, np.inf, -1e-15])
def test_p_value_is_that_of_the_chi2_distribution(dof: int, chi2: float):
    assert Candidate(0, chi2, dof, 0.0, True).p_value == chi2_distribution.sf(chi2, dof)
