"""What errors of neighbouring points have in common: found in the residuals of planes, part of their covariance.

Surfaces are uneven, ranges biased, sweeps warped: errors of points side by side agree, over centimetres and over
metres. Averaging removes nothing of them. They show as residuals that agree over a patch of a plane. Their spectrum is
taken as that of 1/f noise, whose every octave of wavelengths has the same variance: of all fields it alone has no scale
of its own, so that one number, the standard deviation of an octave, serves planes of every size (de Wijs' process).

The residual of patch c of a plane is then its noise of variance s^2 / W_c and a part with the covariance
tau^2 K(h), K(h) = 1 + log2(D / h) between patches h apart on a plane of diameter D. s^2 is the scatter inside of
patches over what is stated, tau^2 is found by restricted maximum likelihood (REML) from the contrasts of the patches
that no offset and tilt of the plane explains, over all planes of a cloud: one number a sensor. A plane that the common
one does not explain has its own. Where residuals do not refuse tau = 0, it is 0.

References:
    Patterson, Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika 1971, for REML.
    Matheron, "The intrinsic random functions", Advances in Applied Probability 1973, for the logarithmic covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from spplanes._check import FloatArray
from spplanes.fitting._patch_sums import RESIDUAL, SIDE, SQUARE, WEIGHT, N, X, Y, add_to_patches

#: Share of the sensors without such errors that are taken to have some.
SIGNIFICANCE = 1e-3
#: Mean distance of the points of a rectangle, as exp(mean log), in the sum of its sides (Maxwell's geometric mean).
MEAN_DISTANCE = 0.2235
#: A uniform rectangle's half side in standard deviations.
_HALF = 3.0**0.5
#: tau^2 is looked for on a grid of so many values a factor of ten, then between them.
_PER_DECADE, _DECADES = 8, 12


@dataclass(frozen=True, eq=False)
class SharedError:
    """The shared error of a set of planes."""

    octave_sigma_m: float
    """Standard deviation of an octave of wavelengths that most planes share, m; 0 where residuals show none."""
    octave_sigmas_m: FloatArray
    """The same of every plane, shape (P,), m."""
    noise_factors: FloatArray
    """Variance of the points about their patches over what was stated, of every plane, shape (P,)."""
    covariances: FloatArray
    """Of (z, theta, psi) of every plane, noise and shared error together, shape (P, 3, 3)."""


def shared_error_of(
    points: FloatArray,
    variances: FloatArray,
    groups: np.ndarray,
    frames: FloatArray,
    covariances: FloatArray,
    *,
    stated: bool,
    least_m: float = 0.0,
    estimate: bool = True,
) -> SharedError:
    """The error that neighbouring points share, and with it the covariances of their planes.

    Args:
        points: shape (N, 3), m.
        variances: of the points, shape (N, 1) isotropic or (N, 9), or of one for all, m^2.
        groups: plane of every point, shape (N,), -1 = none.
        frames: world_T_plane of the planes, shape (P, 4, 4).
        covariances: of (z, theta, psi) by the stated noise alone, shape (P, 3, 3).
        stated: whether the variances are a lower bound, or a guess that residuals may lower.
        least_m: least standard deviation of an octave, m.
        estimate: look for more; else the noise is what was stated, and the shared error the least.
    """
    least, ones = np.full(len(frames), least_m), np.ones(len(frames))
    if not len(frames) or not (estimate or least_m):
        return SharedError(least_m, least, ones, covariances)
    patches = _Patches.of(points, variances, groups, frames, covariances)
    if not estimate:
        return SharedError(least_m, least, ones, patches.covariances(covariances, ones, least**2))
    factors = patches.noise_factors(stated)
    values, squares = patches.contrasts(factors)
    common, own = _reml(values, squares, least_m**2)
    return SharedError(float(np.sqrt(common)), np.sqrt(own), factors, patches.covariances(covariances, factors, own))


def octave_sigma_of(
    points: FloatArray, variances: FloatArray, groups: np.ndarray, frames: FloatArray, spreads: FloatArray
) -> float:
    """Standard deviation of an octave of the error that neighbouring points share, m.

    Args:
        points, variances, groups, frames: as of `shared_error_of`; variances are a guess.
        spreads: information of (z, theta, psi) by the noise alone, its diagonal, shape (P, 3).
    """
    covariances = np.zeros((len(frames), 3, 3))
    covariances[:, (0, 1, 2), (0, 1, 2)] = 1.0 / spreads
    return shared_error_of(points, variances, groups, frames, covariances, stated=False).octave_sigma_m


@dataclass(frozen=True, eq=False)
class _Patches:
    """What patches of planes say: SIDE^2 of each, P planes."""

    weights: FloatArray
    """Sums of 1 / variance, shape (P, M), 1 / m^2; 0 where a patch is empty."""
    means: FloatArray
    """Mean residuals, shape (P, M), m."""
    design: FloatArray
    """(1, -x, y) of their centres, the derivative of a residual by (z, theta, psi), shape (P, M, 3)."""
    kernel: FloatArray
    """K between patches, shape (P, M, M)."""
    chi2: FloatArray
    """Of the points about the means of their patches, shape (P,)."""
    dof: FloatArray
    """Degrees of freedom of that, shape (P,)."""

    @classmethod
    def of(
        cls, points: FloatArray, variances: FloatArray, groups: np.ndarray, frames: FloatArray, covariances: FloatArray
    ) -> _Patches:
        """Part every plane, its sides by its own spread: information of a tilt over that of the offset is x^2."""
        diagonal = np.diagonal(covariances, axis1=1, axis2=2)
        half = _HALF * np.sqrt(diagonal[:, :1] / diagonal[:, 1:])
        blurred = half < SIDE * _noise_along(variances, groups, len(frames))[:, None]
        sums = np.zeros((len(frames), SIDE, SIDE, 6))
        add_to_patches(points, variances, groups, frames, np.where(blurred, np.inf, half), sums)
        sums = sums.reshape(len(frames), SIDE * SIDE, 6)
        weights = sums[..., WEIGHT]
        safe = np.where(weights > 0.0, weights, 1.0)
        means, x, y = (sums[..., k] / safe for k in (RESIDUAL, X, Y))
        chi2 = (sums[..., SQUARE] - weights * means**2).sum(axis=1)
        dof = sums[..., N].sum(axis=1) - (weights > 0.0).sum(axis=1)
        diameter = 2.0 * np.hypot(half[:, 0], half[:, 1])
        square = (x[:, :, None] - x[:, None, :]) ** 2 + (y[:, :, None] - y[:, None, :]) ** 2
        within = MEAN_DISTANCE * 2.0 * half.sum(axis=1) / SIDE  # of the points of a patch, and a blur between patches
        apart = np.minimum(np.sqrt(square + within[:, None, None] ** 2), diameter[:, None, None])
        kernel = 1.0 + np.log2(diameter[:, None, None] / apart)
        return cls(weights, means, np.stack((np.ones_like(x), -x, y), axis=-1), kernel, chi2, dof)

    def noise_factors(self, stated: bool) -> FloatArray:
        """Variance of the points inside of patches over the stated one, shape (P,)."""
        dof = np.maximum(self.dof, 1.0)
        own = self.chi2 / dof
        common = weighted_median(own, self.dof) if self.dof.sum() > 0.0 else 1.0
        refused = self.chi2.sum() > chdtri(max(self.dof.sum(), 1.0), SIGNIFICANCE)
        common = max(common if refused else 1.0, 1.0) if stated else max(common, 1e-12)
        return np.where(self.chi2 > common * chdtri(dof, SIGNIFICANCE), np.maximum(own, common), common)

    def contrasts(self, factors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Variances that tau^2 = 1 gives the contrasts of every plane beside noise of 1, and their squares, (P, M)."""
        root = np.sqrt(self.weights / factors[:, None])
        trend = root[..., None] * self.design
        size = np.sqrt((trend**2).sum(axis=1, keepdims=True))
        trend = trend / np.where(size > 0.0, size, 1.0)
        square = np.swapaxes(trend, 1, 2) @ trend + 1e-9 * np.eye(3)
        project = np.eye(root.shape[1]) - trend @ np.linalg.solve(square, np.swapaxes(trend, 1, 2))
        values, vectors = np.linalg.eigh(project @ (root[:, :, None] * self.kernel * root[:, None, :]) @ project)
        seen = np.einsum("pmk,pm->pk", vectors, np.einsum("pmn,pn->pm", project, root * self.means))
        return np.where(values > 1e-3 * values[:, -1:], values, 0.0), seen**2

    def covariances(self, covariances: FloatArray, factors: FloatArray, taus: FloatArray) -> FloatArray:
        """Of (z, theta, psi): of the weighted fit, whose points share an error it did not know of."""
        gain = covariances @ (np.swapaxes(self.design, 1, 2) * self.weights[:, None, :])
        shared = gain @ self.kernel @ np.swapaxes(gain, 1, 2)
        total = factors[:, None, None] * covariances + taus[:, None, None] * shared
        return 0.5 * (total + np.swapaxes(total, 1, 2))


def _noise_along(variances: FloatArray, groups: np.ndarray, n_planes: int) -> FloatArray:
    """Standard deviation of the points of every plane in any direction, shape (P,), m.

    Patches narrower than two of it would sort points by their noise, which goes together with that of the residuals.
    """
    traces = variances[:, 0] if variances.shape[1] == 1 else variances[:, [0, 4, 8]].sum(axis=1)
    held = groups >= 0
    sums = np.bincount(groups[held], np.broadcast_to(traces, groups.shape)[held], minlength=n_planes)
    return np.sqrt(sums / np.maximum(np.bincount(groups[held], minlength=n_planes), 1))


def _reml(values: FloatArray, squares: FloatArray, least: float) -> tuple[float, FloatArray]:
    """tau^2 of most planes, and of each of them, (P,), m^2; see `_Patches.contrasts`.

    That of most is the median, each plane as often as it has contrasts that tell: planes differ by more than their
    estimates' errors, and one that is two surfaces must not speak for all. A plane that is worse, as the common value
    would have it in one case of a thousand, has its own.
    """
    own = np.array([_likeliest(values[p : p + 1], squares[p : p + 1]) for p in range(len(values))])
    limit, pooled = chdtri(1, 2.0 * SIGNIFICANCE), _likeliest(values, squares)
    common = least
    if 2.0 * (_total(values, squares, pooled) - _total(values, squares, 0.0)) > limit:
        signal = pooled * values / (1.0 + pooled * values)
        common = max(weighted_median(own, (signal**2).sum(axis=1)), least)
    gain = _log_likelihood(values, squares, np.maximum(own, common)) - _log_likelihood(values, squares, common)
    return common, np.where(2.0 * gain > limit, np.maximum(own, common), common)


def weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """The least of values (N,) that half of the weights (N,) lie at or below."""
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(share, 0.5 * share[-1])]])


def _log_likelihood(values: FloatArray, squares: FloatArray, tau: FloatArray | float) -> FloatArray:
    """Of the contrasts of every plane, up to a constant, shape (P,)."""
    variance = 1.0 + values * np.reshape(tau, (-1, 1))
    seen = values > 0.0
    return -0.5 * np.where(seen, np.log(variance) + squares / variance, 0.0).sum(axis=1)


def _total(values: FloatArray, squares: FloatArray, tau: float) -> float:
    return float(_log_likelihood(values, squares, tau).sum())


def _likeliest(values: FloatArray, squares: FloatArray) -> float:
    """tau^2 >= 0 at the maximum of the likelihood of planes that share it."""
    largest = values.max(initial=0.0)
    if largest <= 0.0:
        return 0.0
    grid = np.concatenate(([0.0], 10.0 ** np.arange(-3.0, _DECADES - 3.0, 1.0 / _PER_DECADE) / largest))
    variance = 1.0 + values.ravel() * grid[:, None]
    terms = np.where(values.ravel() > 0.0, np.log(variance) + squares.ravel() / variance, 0.0)
    best = int((-terms.sum(axis=1)).argmax())
    if best in (0, len(grid) - 1):
        return float(grid[best])
    low, high = grid[best - 1], grid[best + 1]
    for _ in range(20):  # golden sections are not worth their lines: a third is cut off each time
        a, b = low + (high - low) / 3.0, high - (high - low) / 3.0
        if _total(values, squares, a) < _total(values, squares, b):
            low = a
        else:
            high = b
    return 0.5 * (low + high)
