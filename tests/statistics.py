"""What the statistical tests share: chi2 bands and central differences."""

from collections.abc import Callable

import numpy as np
from scipy.stats import chi2


def mean_nees_band(runs: int, dof: int, level: float = 0.99) -> tuple[float, float]:
    """Two-sided interval of the mean of ``runs`` independent chi2 numbers of ``dof`` degrees of freedom each."""
    tail = 0.5 * (1.0 - level)
    low, high = chi2.ppf((tail, 1.0 - tail), runs * dof) / runs
    return float(low), float(high)


def nees(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Normalised squared errors, shape (R,), of ``errors`` (R, k) under ``covariances`` (R, k, k)."""
    return np.einsum("ri,ri->r", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def assert_mean_in_band(values: np.ndarray, dof: int, level: float = 0.99) -> None:
    """The mean of independent chi2 numbers is what it should be."""
    low, high = mean_nees_band(len(values), dof, level)
    mean = float(np.mean(values))
    assert low <= mean <= high, f"mean {mean:.4f} outside [{low:.4f}, {high:.4f}] for {dof} degrees of freedom"


def central_differences(f: Callable[[np.ndarray], np.ndarray], x: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """Jacobian of ``f`` at ``x`` (n,), shape (m, n)."""
    x, columns = np.asarray(x, dtype=float), []
    for k in range(len(x)):
        delta = np.zeros_like(x)
        delta[k] = step
        columns.append((np.asarray(f(x + delta), dtype=float) - np.asarray(f(x - delta), dtype=float)) / (2.0 * step))
    return np.stack(columns, axis=-1)


def assert_jacobian(
    f: Callable[[np.ndarray], np.ndarray],
    x: np.ndarray,
    jacobian: np.ndarray,
    *,
    step: float = 1e-5,
    atol: float = 1e-8,
    rtol: float = 1e-6,
) -> None:
    """``jacobian`` (m, n) is the derivative of ``f`` at ``x`` (n,), by central differences."""
    np.testing.assert_allclose(jacobian, central_differences(f, x, step), atol=atol, rtol=rtol)
