"""What errors of neighbouring points have in common: found in the residuals of planes, part of their covariance.

Surfaces are uneven, ranges biased, sweeps warped: errors of points side by side agree, over centimetres and over
metres. Averaging removes nothing of them. They show as residuals that agree over a patch of a plane. Their spectrum is
taken as that of 1/f noise, whose every octave of wavelengths has the same variance: of all fields it alone has no scale
of its own, so that one number, the standard deviation of an octave, serves planes of every size (de Wijs' process).

The residual of patch c of a plane is then its noise of variance s^2 / W_c and a part with the covariance
tau^2 K(h), K(h) = 1 + log2(D / h) between patches h apart on a plane of diameter D. s^2 is the scatter inside of
patches over what is stated, tau^2 is told by the restricted likelihood (REML) of the contrasts of the patches that no
offset and tilt of the plane explains. Surfaces differ, plaster from a row of cupboards, by more than their contrasts
leave open: log tau^2 of the planes of a cloud is taken as normal, its mean and spread are learnt from all of them
(empirical Bayes), and tau^2 of each is its mean given its own contrasts. It is 0 unless residuals refuse that.

References:
    Patterson, Thompson, "Recovery of inter-block information when block sizes are unequal", Biometrika 1971, for REML.
    Matheron, "The intrinsic random functions", Advances in Applied Probability 1973, for the logarithmic covariance.
    Robbins, "An empirical Bayes approach to statistics", Berkeley Symposium 1956.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from spplanes._check import FloatArray
from spplanes._jit import njit
from spplanes._rows import column, in_frame
from spplanes.fitting.rounding import with_rounding

#: Patches along each side of a plane.
SIDE = 5
#: Share of the sensors without such errors that are taken to have some.
SIGNIFICANCE = 1e-3
#: Mean distance of the points of a rectangle, as exp(mean log), in the sum of its sides (Maxwell's geometric mean).
MEAN_DISTANCE = 0.2235
#: tau^2 is looked at where it gives the largest contrast so many times the variance of its noise.
_MULTIPLES = 10.0 ** np.arange(-3.0, 9.0, 0.1)
#: Populations of log tau^2: their means are at some of those multiples, these are their standard deviations.
_MEANS, _SPREADS = slice(None, None, 3), np.array([0.3, 0.6, 1.0, 1.5, 2.0, 3.0])


@dataclass(frozen=True, eq=False)
class SharedError:
    """The shared error of a set of planes."""

    octave_sigma_m: float
    """Standard deviation of an octave of wavelengths, m: of half of the planes less; 0 where residuals show none."""
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

    What rounded coordinates have in common is part of the covariances as well (`spplanes.fitting.rounding`).

    Args:
        points, groups: shape (N, 3), m, and the plane of each, shape (N,), -1 = none.
        variances: of the points, shape (N, 1) isotropic or (N, 9), or of one for all, m^2.
        frames, covariances: world_T_plane, (P, 4, 4); of (z, theta, psi) by the stated noise alone, (P, 3, 3).
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
    common, own = patches.octaves(factors, least_m**2)
    total = patches.covariances(covariances, factors, own)
    total = with_rounding(total, covariances, points, frames, patches.scatter())
    return SharedError(float(np.sqrt(common)), np.sqrt(own), factors, total)


class _Patches(NamedTuple):
    """What patches of planes say: SIDE^2 of each, P planes."""

    weights: FloatArray
    """Sums of 1 / variance, shape (P, M), 1 / m^2; 0 where a patch is empty."""
    means: FloatArray
    """Mean residuals, shape (P, M), m."""
    design: FloatArray
    """(1, -x, y) of their centres, the derivative of a residual by (z, theta, psi), shape (P, M, 3)."""
    diameters: FloatArray
    """Of the planes, shape (P,), m."""
    within: FloatArray
    """Distance of the points of a patch, and a blur between patches, shape (P,), m."""
    chi2: FloatArray
    """Of the points about the means of their patches, shape (P,), and its degrees of freedom."""
    dof: FloatArray

    @classmethod
    def of(
        cls, points: FloatArray, variances: FloatArray, groups: np.ndarray, frames: FloatArray, covariances: FloatArray
    ) -> _Patches:
        """Part every plane, its sides by its own spread: information of a tilt over that of the offset is x^2."""
        diagonal = np.diagonal(covariances, axis1=1, axis2=2)
        half = 3.0**0.5 * np.sqrt(diagonal[:, :1] / diagonal[:, 1:])  # of a uniform rectangle
        blurred = half < SIDE * _noise_along(variances, groups, len(frames))[:, None]
        sums = np.zeros((len(frames), SIDE, SIDE, 6))
        _add_to_patches(points, variances, groups, frames, np.where(blurred, np.inf, half), sums)
        numbers, weights, residuals, squares, x, y = np.moveaxis(sums.reshape(len(frames), SIDE * SIDE, 6), -1, 0)
        safe = np.where(weights > 0.0, weights, 1.0)
        means, x, y = residuals / safe, x / safe, y / safe
        chi2 = (squares - weights * means**2).sum(axis=1)
        dof = numbers.sum(axis=1) - (weights > 0.0).sum(axis=1)
        diameter = 2.0 * np.hypot(half[:, 0], half[:, 1])
        within = MEAN_DISTANCE * 2.0 * half.sum(axis=1) / SIDE
        return cls(weights, means, np.stack((np.ones_like(x), -x, y), axis=-1), diameter, within, chi2, dof)

    def kernel(self, planes: np.ndarray) -> FloatArray:
        """K between the patches of some planes, shape (N, M, M)."""
        x, y = self.design[planes, :, 1], self.design[planes, :, 2]
        square = (x[:, :, None] - x[:, None, :]) ** 2 + (y[:, :, None] - y[:, None, :]) ** 2
        square += self.within[planes, None, None] ** 2
        diameters = self.diameters[planes, None, None] ** 2
        return 1.0 + 0.5 * np.log2(diameters / np.minimum(square, diameters))

    def noise_factors(self, stated: bool) -> FloatArray:
        """Variance of the points inside of patches over the stated one, shape (P,)."""
        dof = np.maximum(self.dof, 1.0)
        own = self.chi2 / dof
        common = weighted_median(own, self.dof) if self.dof.sum() > 0.0 else 1.0
        refused = self.chi2.sum() > chdtri(max(self.dof.sum(), 1.0), SIGNIFICANCE)
        common = max(common if refused else 1.0, 1.0) if stated else max(common, 1e-4)  # never none
        return np.where(self.chi2 > common * chdtri(dof, _of_one(len(dof), refused)), np.maximum(own, common), common)

    def scatter(self) -> FloatArray:
        """Variance of the points inside of patches, as it is seen, shape (P,), m^2."""
        counts, weights = self.dof + np.count_nonzero(self.weights, axis=1), self.weights.sum(axis=1)
        return self.chi2 / np.maximum(self.dof, 1.0) * counts / np.where(weights > 0.0, weights, 1.0)

    def octaves(self, factors: FloatArray, least: float) -> tuple[float, FloatArray]:
        """tau^2 of the median plane, and of each, (P,), m^2; of those alone that may have any, if most have none."""
        common, own = least, np.full(len(factors), least)
        score, variance = np.concatenate([self._scores(one, factors) for (one,) in _few(np.arange(len(own)))], axis=1)
        # likelihoods are worked out where the slope at tau = 0 is above two standard deviations
        most = bool(score.sum() > 2.0 * np.sqrt(variance.sum()))
        asked = np.flatnonzero(most | (score > 2.0 * np.sqrt(variance)))
        if len(asked):
            common, own[asked] = _of_planes(*self._contrasts(asked, factors), least, most, len(own))
        return common, own

    def _whitened(
        self, planes: np.ndarray, factors: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Of some planes, with noise of 1: means (N, M), K (N, M, M), what offset and tilt explain, columns of
        X (N, M, 3), and (X^T X)^-1 (N, 3, 3)."""
        root = np.sqrt(self.weights[planes] / factors[planes, None])
        kernel = root[:, :, None] * self.kernel(planes) * root[:, None, :]
        trend = root[..., None] * self.design[planes]
        size = np.sqrt((trend**2).sum(axis=1, keepdims=True))
        trend = trend / np.where(size > 0.0, size, 1.0)
        square = np.swapaxes(trend, 1, 2) @ trend + 1e-9 * np.eye(3)
        return root * self.means[planes], kernel, trend, np.linalg.inv(square).astype(np.float64)

    def _scores(self, planes: np.ndarray, factors: FloatArray) -> FloatArray:
        """Twice the slope of the log likelihood at tau^2 = 0, its expectation 0, and its variance there, (2, N): with r
        what the trend T leaves of the means and A = K T, r^T K r - tr(P K), and 2 tr(P K P K)."""
        seen, kernel, trend, inverse = self._whitened(planes, factors)
        back = np.swapaxes(trend, 1, 2)
        seen = seen - (trend @ (inverse @ (back @ seen[..., None])))[..., 0]
        across = kernel @ trend
        explained = inverse @ (back @ across)
        squares = np.einsum("pmn,pmn->p", kernel, kernel) - 2.0 * np.einsum("pij,pmj,pmi->p", inverse, across, across)
        squares += np.einsum("pij,pji->p", explained, explained)
        expected = np.trace(kernel, axis1=1, axis2=2) - np.trace(explained, axis1=1, axis2=2)
        score = (seen * (kernel @ seen[..., None])[..., 0]).sum(axis=1) - expected
        return np.stack((score, np.maximum(2.0 * squares, 0.0)))

    def _contrasts(self, planes: np.ndarray, factors: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Variances that tau^2 = 1 gives contrasts beside noise of 1, ascending, and the squares of these, (P, M)."""
        means, kernel, trend, inverse = self._whitened(planes, factors)
        project = np.eye(means.shape[1]) - trend @ inverse @ np.swapaxes(trend, 1, 2)
        values, vectors = np.linalg.eigh(project @ kernel @ project)
        seen = np.einsum("pmk,pm->pk", vectors, np.einsum("pmn,pn->pm", project, means))
        return np.where(values > 1e-3 * values[:, -1:], values, 0.0), seen**2

    def covariances(self, covariances: FloatArray, factors: FloatArray, taus: FloatArray) -> FloatArray:
        """Of (z, theta, psi): of the weighted fit, whose points share an error it did not know of."""
        total, uneven = factors[:, None, None] * covariances, np.flatnonzero(taus)
        gain = covariances[uneven] @ (np.swapaxes(self.design[uneven], 1, 2) * self.weights[uneven, None, :])
        total[uneven] += taus[uneven, None, None] * (gain @ self.kernel(uneven) @ np.swapaxes(gain, 1, 2))
        return 0.5 * (total + np.swapaxes(total, 1, 2))


def _of_one(n_planes: int, shared: bool) -> float:
    """Significance at which one plane of many has an error; where none has, one false alarm among all is bad enough."""
    return SIGNIFICANCE if shared else SIGNIFICANCE / n_planes


def _noise_along(variances: FloatArray, groups: np.ndarray, n_planes: int) -> FloatArray:
    """Standard deviation of the points of every plane in any direction, (P,), m, of many by a sample: patches narrower
    than two of it would sort points by their noise, which goes together with that of the residuals."""
    if len(variances) == 1 < len(groups):
        return np.full(n_planes, np.sqrt(_traces(variances)[0]))
    some = slice(None, None, max(len(groups) // (1000 * n_planes), 1))
    place = groups[some] + 1  # one more for points of no plane
    sums = np.bincount(place, _traces(variances[some]), minlength=n_planes + 1)[1:]
    counts = np.bincount(place, minlength=n_planes + 1)[1:]
    return np.sqrt(np.where(counts > 0, sums, sums.sum()) / np.where(counts > 0, counts, max(counts.sum(), 1)))


def _traces(variances: FloatArray) -> FloatArray:
    return variances[:, 0] if variances.shape[1] == 1 else variances[:, 0] + variances[:, 4] + variances[:, 8]


def _of_planes(
    values: FloatArray, squares: FloatArray, least: float, most: bool, n_planes: int
) -> tuple[float, FloatArray]:
    """tau^2 of the median plane, and of each of those that are asked, (P,), m^2, by their contrasts
    (`_Patches._contrasts`). ``most``: whether all ``n_planes`` together hint at more than the ``least``."""
    # Of the contrasts, ascending, those of the longer waves alone: of a real wall the octaves next to it tell most of
    # what turns it, and short ones, which are many, would speak louder. The others are as of those that tell nothing.
    longer = np.arange(values.shape[1])[::-1]
    values = np.where(2 * longer < np.count_nonzero(values, axis=1)[:, None], values, 0.0)
    if not values.any():
        return least, np.full(len(values), least)
    taus = np.maximum(_MULTIPLES / values.max(), least)
    likelihoods = np.concatenate([_log_likelihood(v, s, taus[:, None]).T for v, s in _few(values, squares)])
    gains = likelihoods - _log_likelihood(values, squares, least)[:, None]
    shared = most and 2.0 * gains.sum(axis=0).max() > chdtri(1, 2.0 * SIGNIFICANCE)
    # Half of what the contrasts of one plane tell of its tau^2 is believed: that its longer waves, which turn it, are
    # of the same variance is an assumption. Angles between planes seen twice by two lidars and a Kinect, mean chi2, and
    # share beyond 99.9 %: by all of it .57 to 1.6, 0 to 2.8 %; by half .52 to 1.1, 0 to 1.1 %.
    relative = np.exp(0.5 * (likelihoods - likelihoods.max(axis=1, keepdims=True)))
    if shared:
        return _of_a_population(relative, taus)
    limit = chdtri(1, 2.0 * _of_one(n_planes, bool(least)))
    return least, np.where(2.0 * gains.max(axis=1) > limit, relative @ taus / relative.sum(axis=1), least)


def _few(*arrays: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """Arrays of one length, so many of their rows at a time that what is worked on stays in the processor's cache."""
    yield from zip(*(np.array_split(one, len(one) // 50 + 1) for one in arrays), strict=True)


def _of_a_population(likelihoods: FloatArray, taus: FloatArray) -> tuple[float, FloatArray]:
    """The median of a population of tau^2, and that of each of its planes, (P,), by likelihoods (P, T) at T of them."""
    populations = _populations()
    evidence = np.maximum(likelihoods @ populations.T, np.finfo(float).tiny)
    log_weights = np.log(evidence).sum(axis=0)
    weights = np.exp(log_weights - log_weights.max())
    weights /= weights.sum()
    means = (likelihoods * taus) @ populations.T / evidence
    middles = np.repeat(np.log(taus[_MEANS]), len(_SPREADS))
    return float(np.exp(weights @ middles)), means @ weights


@cache
def _populations() -> FloatArray:
    """Probabilities of the multiples in every population, all spreads of one mean after another, shape (H, T)."""
    off = np.log(_MULTIPLES[_MEANS, None] / _MULTIPLES)
    densities = np.exp(-0.5 * (off[:, None, :] / _SPREADS[:, None]) ** 2)
    return (densities / densities.sum(axis=-1, keepdims=True)).reshape(-1, len(_MULTIPLES))


def weighted_median(values: FloatArray, weights: FloatArray) -> float:
    """The least of values (N,) that half of the weights (N,) lie at or below."""
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order])
    return float(values[order[np.searchsorted(share, 0.5 * share[-1])]])


def _log_likelihood(values: FloatArray, squares: FloatArray, tau: FloatArray | float) -> FloatArray:
    """Of the contrasts of every plane, up to a constant, for tau^2 of any shape (..., P); the same shape."""
    variance = 1.0 + values * np.asarray(tau)[..., None]
    return -0.5 * np.where(values > 0.0, np.log(variance) + squares / variance, 0.0).sum(axis=-1)


@njit(cache=True)
def _add_to_patches(points, variances, groups, frames, half, sums):
    """Add every point's residual to the sums (P, SIDE, SIDE, 6) of its patch, in place. Points (N, 3), m, of ``groups``
    (N,), -1 = none, have ``variances`` (N, 1) or (N, 9), or (1, .) for all, m^2. ``half`` (P, 2), m, are half the sides
    of the rectangles that are parted; points beyond are of the rim."""
    isotropic = variances.shape[1] == 1
    for k in range(points.shape[0]):
        g = groups[k]
        if g < 0:
            continue
        f = frames[g]
        (x, y, z), (n0, n1, n2) = in_frame(points, k, f), column(f, 2)
        v = variances[min(k, variances.shape[0] - 1)]
        if isotropic:
            along = v[0]
        else:
            along = n0 * (n0 * v[0] + n1 * (v[1] + v[3]) + n2 * (v[2] + v[6]))
            along += n1 * (n1 * v[4] + n2 * (v[5] + v[7])) + n2 * n2 * v[8]
            along = max(along, 1e-3 * (v[0] + v[4] + v[8]))
        i = int(min(max((x / half[g, 0] + 1.0) * 0.5 * SIDE, 0.0), SIDE - 1.0))
        j = int(min(max((y / half[g, 1] + 1.0) * 0.5 * SIDE, 0.0), SIDE - 1.0))
        w, cell = 1.0 / along, sums[g, i, j]
        cell[0] += 1.0
        cell[1] += w
        cell[2] += w * z
        cell[3] += w * z * z
        cell[4] += w * x
        cell[5] += w * y
