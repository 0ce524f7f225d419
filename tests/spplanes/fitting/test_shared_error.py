"""The error that neighbouring points share: found where it is, not found where it is not, and covariances that hold."""

import numpy as np
import pytest
from scipy.stats import chi2

from spplanes import fit_plane
from spplanes.fitting.shared_error import shared_error_of

SIGMA_M, N_WALLS = 0.005, 6


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


def walls(octave_m: float, seed: int):
    """What `shared_error_of` says of six walls, and the errors (6, 3) of their (z, theta, psi)."""
    rng = np.random.default_rng(seed)
    points = [wall(octave_m, rng) for _ in range(N_WALLS)]
    planes = [fit_plane(one, sigma=SIGMA_M, viewpoint=(0.0, 0.0, 9.0)) for one in points]
    found = shared_error_of(
        np.concatenate(points),
        np.array([[SIGMA_M**2]]),
        np.repeat(np.arange(N_WALLS), 3000),
        np.array([plane.frame for plane in planes]),
        np.array([plane.covariance for plane in planes]),
        stated=True,
    )
    errors = []
    for plane in planes:
        slope = plane.frame[:3, :3].T @ (0.0, 0.0, 1.0)
        errors.append([-plane.centre[2] / plane.normal[2], slope[0] / slope[2], -slope[1] / slope[2]])
    return found, np.array(errors)


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
    """Without the shared part the mean chi2 of a tilt is 6, 90 and 2000."""
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
    points = [wall(0.01 if k == 0 else 0.0, rng) for k in range(N_WALLS)]
    planes = [fit_plane(one, sigma=SIGMA_M, viewpoint=(0.0, 0.0, 9.0)) for one in points]
    frames, covariances = (np.array([getattr(one, name) for one in planes]) for name in ("frame", "covariance"))
    groups = np.repeat(np.arange(N_WALLS), 3000)
    found = shared_error_of(np.concatenate(points), np.array([[SIGMA_M**2]]), groups, frames, covariances, stated=True)
    assert found.octave_sigmas_m[0] == pytest.approx(0.01, rel=0.5)
    assert (found.octave_sigmas_m[1:] < 0.001).all()


def test_noise_that_was_stated_too_small_is_seen_and_too_large_is_believed():
    rng = np.random.default_rng(1)
    points = wall(0.0, rng)
    plane = fit_plane(points, sigma=SIGMA_M, viewpoint=(0.0, 0.0, 9.0))
    for stated, expected in ((0.5, 4.0), (1.0, 1.0), (2.0, 1.0)):
        covariance = plane.covariance * stated**2
        variance = np.array([[(stated * SIGMA_M) ** 2]])
        groups = np.zeros(3000, dtype=int)
        found = shared_error_of(points, variance, groups, plane.frame[None], covariance[None], stated=True)
        assert found.noise_factors[0] == pytest.approx(expected, rel=0.15)
        np.testing.assert_allclose(found.covariances[0], found.noise_factors[0] * covariance)
