"""Squared Mahalanobis distance for covariances that may be singular."""

from __future__ import annotations

import numpy as np

from spplanes._check import TOO_LARGE, FloatArray


def chi2_of(difference: FloatArray, covariance: FloatArray) -> float:
    """difference^T covariance^-1 difference; infinite where a certain direction differs."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale[scale <= 1.0 / TOO_LARGE] = 1.0  # certain
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    parts = vectors.T @ (difference / scale)
    certain = values <= 1e-14
    if (np.abs(parts[certain]) > 1e-12).any():
        return np.inf
    return float(np.sum(parts[~certain] ** 2 / values[~certain]))
