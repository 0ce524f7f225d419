"""The error that neighbouring points share: found where it is, not found where it is not, and covariances that hold."""

import numpy as np
import pytest
from scipy.stats import chi2

from spplanes import fit_plane, fit_planes
from spplanes.fitting.shared_error import _log_likelihood, _Patches, shared_error_of
from tests.spplanes.fitting.fit_scenes import error_of

SIGMA_M, N_WALLS, EYE = 0.005, 6, (0.0, 0.0, 9.0)


def wandering(octave_m: float, rng: np.random.Generator, size: int = 128) -> np.ndarray:
    """A field (size, size) whose octaves have the same variance: 1/k^2 in two dimensions, and nothing beyond it."""
    k = np.fft.fftfreq(size) * size
    length = np.hypot(*np.meshgrid(k, k))
    length[0, 0] = np.inf
    power = octave_m**2 / (2.0 * np.pi * np.log(2.0))
    waves = rng.normal(size=(2, size, size)) * np.sqrt(power) / length
    return (np.fft.ifft2(waves[0] + 1j * waves[1]) * size**2).real


def wall(octave_m: float, rng: np.random.Generator) -> np.ndarray:
    """3000 points of a wall z = 0 of 4 x 2 m that wanders, with noise, shape (3000, 3)."""
    x, y = rng.uniform(0.0, 4.0, 3000), rng.uniform(0.0, 2.0, 3000)
    z = SIGMA_M * rng.normal(size=3000)
    if octave_m:
        field = wandering(octave_m, rng)
        z += field[(x * 16.0).astype(int), (y * 16.0).astype(int)]  # waves of up to 8 m
    return np.column_stack((x, y, z))


def told(points: list[np.ndarray], stated: float = 1.0):
    """What `shared_error_of` says of walls whose noise is stated as so many times what it is, and their planes."""
    planes = [fit_plane(one, sigma=SIGMA_M, viewpoint=EYE, shared_error=False) for one in points]
    frames, covariances = (np.array([getattr(one, name) for one in planes]) for name in ("frame", "covariance"))
    variances, groups = np.array([[(stated * SIGMA_M) ** 2]]), np.repeat(np.arange(len(points)), 3000)
    found = shared_error_of(np.concatenate(points), variances, groups, frames, stated**2 * covariances, stated=True)
    return found, planes


def squared_tilts(plane) -> np.ndarray:
    """Of a wall z = 0, over what is claimed of them, shape (2,)."""
    return error_of(plane.frame, np.eye(4))[1:] ** 2 / np.diagonal(plane.covariance)[1:]


def walls(octave_m: float, seed: int):
    """What is said of six walls, and their errors (6, 3)."""
    rng = np.random.default_rng(seed)
    found, planes = told([wall(octave_m, rng) for _ in range(N_WALLS)])
    return found, np.array([error_of(plane.frame, np.eye(4)) for plane in planes])


def test_exact_walls_keep_the_covariance_of_their_noise():
    runs, nees = 40, 0.0
    for seed in range(runs):
        found, errors = walls(0.0, seed)
        assert found.octave_sigma_m == 0.0
        nees += np.einsum("pi,pij,pj->", errors, np.linalg.inv(found.covariances), errors)
    low, high = chi2.ppf([0.001, 0.999], 3 * runs * N_WALLS) / (runs * N_WALLS)
    assert low < nees / (runs * N_WALLS) < high  # twice or half the covariance: beyond by ten standard deviations


@pytest.mark.parametrize("octave_m", [0.0005, 0.002, 0.01])
def test_walls_that_wander_are_known_as_well_as_is_said(octave_m):
    """Without the shared part the mean chi2 of a tilt is 16, 246 and 6151."""
    sigmas, tilts, offsets = [], [], []
    for seed in range(15):
        found, errors = walls(octave_m, seed)
        sigmas.append(found.octave_sigma_m)
        chi2_of = errors**2 / np.diagonal(found.covariances, axis1=1, axis2=2)
        tilts.append(chi2_of[:, 1:])
        offsets.append(chi2_of[:, 0])
    assert np.mean(sigmas) == pytest.approx(octave_m, rel=0.3)
    assert 0.5 < np.mean(tilts) < 1.4  # 180 tilts: a standard deviation of 0.11
    assert 0.15 < np.mean(offsets) < 1.4  # waves longer than 8 m are granted, and not there


def test_one_surface_that_is_worse_speaks_for_itself_only():
    rng = np.random.default_rng(0)
    found, _ = told([wall(octave_m, rng) for octave_m in (0.01, 0.0, 0.0, 0.0, 0.0, 0.0)])
    assert found.octave_sigmas_m[0] == pytest.approx(0.01, rel=0.5)
    assert (found.octave_sigmas_m[1:] < 0.001).all()


def test_of_surfaces_that_differ_each_is_known_as_well_as_is_said():
    """A third of the walls ten times as uneven as another."""
    rng, labels, found = np.random.default_rng(6), np.repeat(np.arange(9), 3000), []
    for _ in range(20):
        points = np.concatenate([wall(octave_m, rng) for octave_m in (0.001, 0.003, 0.01) for _ in range(3)])
        planes = fit_planes(points, labels=labels, sigma=SIGMA_M, viewpoint=EYE)
        found.append([squared_tilts(plane) for plane in planes])
    means = np.array(found).reshape(20, 3, 6).mean(axis=(0, 2))  # 120 tilts: a standard deviation of 0.13
    assert (means > 0.4).all() and (means < 1.6).all()  # the least uneven 0.14 where most are taken to be alike


@pytest.mark.parametrize(("stated", "expected"), [(0.5, 4.0), (1.0, 1.0), (2.0, 1.0)])
def test_noise_that_was_stated_too_small_is_seen_and_too_large_is_believed(stated, expected):
    found, (plane,) = told([wall(0.0, np.random.default_rng(1))], stated)
    assert found.noise_factors[0] == pytest.approx(expected, rel=0.15)
    np.testing.assert_allclose(found.covariances[0], found.noise_factors[0] * stated**2 * plane.covariance)


@pytest.mark.parametrize("octave_m", [0.0, 0.002])
def test_one_fit_is_as_sure_as_it_says_on_walls_that_wander_and_on_exact_ones(octave_m):
    """Mean chi2 of a tilt; by the stated noise alone it is some 200 where they wander."""
    rng, tilts, stated = np.random.default_rng(3), [], []
    for _ in range(90):
        points = wall(octave_m, rng)
        for chosen, shared_error in ((tilts, True), (stated, False)):
            plane = fit_plane(points, sigma=SIGMA_M, viewpoint=EYE, shared_error=shared_error)
            chosen.append(squared_tilts(plane))
    assert 0.6 < np.mean(tilts) < 1.4  # 180 tilts: a standard deviation of 0.11
    assert (np.mean(stated) > 30.0) == (octave_m > 0.0)


def test_planes_of_one_call_share_what_most_of_them_show():
    """A plane of few points is as uneven as the walls beside it, which alone it could not tell."""
    rng = np.random.default_rng(4)
    points = [wall(0.01, rng) for _ in range(N_WALLS)]
    labels, every = (
        np.repeat(np.arange(N_WALLS + 1), [60] + [3000] * N_WALLS),
        np.concatenate([points[0][:60], *points]),
    )
    [among, *_] = fit_planes(every, labels=labels, sigma=SIGMA_M)
    [stated, *_] = fit_planes(every, labels=labels, sigma=SIGMA_M, shared_error=False)
    assert among.covariance[1, 1] > 20.0 * stated.covariance[1, 1]


def test_the_slope_that_says_where_to_look_is_that_of_the_likelihood():
    rng = np.random.default_rng(5)
    points = np.concatenate([wall(0.0, rng)[:400] for _ in range(200)])
    groups, variances = np.repeat(np.arange(200), 400), np.array([[SIGMA_M**2]])
    planes = fit_planes(points, labels=groups, sigma=SIGMA_M, shared_error=False)
    frames, covariances = (np.array([getattr(one, name) for one in planes]) for name in ("frame", "covariance"))
    patches, every, ones = _Patches.of(points, variances, groups, frames, covariances), np.arange(200), np.ones(200)
    score, variance = patches._scores(every, ones)
    values, squares = patches._contrasts(every, ones)
    step = 1e-6 / values.max()
    slope = 2.0 * (_log_likelihood(values, squares, step) - _log_likelihood(values, squares, 0.0)) / step
    np.testing.assert_allclose(score, slope, rtol=1e-3, atol=1e-2 * np.sqrt(variance).max())
    assert np.mean(score / np.sqrt(variance)) == pytest.approx(0.0, abs=3.3 / 200**0.5)
    assert np.std(score / np.sqrt(variance)) == pytest.approx(1.0, abs=0.25)
