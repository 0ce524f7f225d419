"""Lines of walls that wander, and of noise that is understated: what a call claims holds by default."""

import numpy as np
import pytest

from spplanes import LineConfig, extract_lines
from tests.statistics import mean_nees_band

ANGLES = np.linspace(-np.pi, np.pi, 720, endpoint=False)
SIGMA_M, HALF_M, ROOMS = 0.005, 3.0, 60
SIDES = np.array([0.0, 0.5, 1.0, 1.5]) * np.pi
#: Of the walls, from where the laser stands, m.
DISTANCES = HALF_M - np.array((1.2, -0.7, -1.2, 0.7))


def wandering(octave_m: float, rng: np.random.Generator, size: int = 256) -> np.ndarray:
    """A profile (size,) whose octaves have the same variance: 1/k in one dimension."""
    k = np.arange(1, size // 2)
    power = octave_m**2 / (2.0 * np.log(2.0) * k)
    waves = np.zeros(size // 2 + 1, dtype=complex)
    waves[1:-1] = (rng.normal(size=(2, k.size)) * np.sqrt(power / 2.0)).T @ (1.0, 1.0j)
    return np.fft.irfft(waves, size) * size


def room(octave_m: float, sigma_m: float, rng: np.random.Generator) -> np.ndarray:
    """Ranges from a place in a square room, 6 m wide, whose walls wander by waves of up to 12 m."""
    ranges = np.full(ANGLES.size, np.inf)
    for side, distance in zip(SIDES, DISTANCES, strict=True):
        profile = wandering(octave_m, rng) if octave_m else np.zeros(256)
        ahead = np.cos(ANGLES - side)
        along = distance * np.tan(ANGLES - side)
        place = np.clip((128.0 + along * 256.0 / 12.0).astype(int), 0, 255)
        with np.errstate(divide="ignore"):
            ranges = np.minimum(ranges, np.where(ahead > 1e-9, (distance + profile[place]) / ahead, np.inf))
    return ranges + sigma_m * rng.normal(size=ANGLES.size)


def mean_chi2(octave_m: float, sigma_m: float, **how: object) -> float:
    """Squared error of (alpha, rho) of all four walls of many rooms over what is claimed, mean, a degree of freedom."""
    rng, found = np.random.default_rng(5), []
    for _ in range(ROOMS):
        for line in extract_lines(room(octave_m, sigma_m, rng), ANGLES, sigma=SIGMA_M, **how):
            off = np.remainder(line.alpha - SIDES + np.pi, 2.0 * np.pi) - np.pi
            side = np.abs(off).argmin()
            if np.linalg.norm(line.endpoints[1] - line.endpoints[0]) > 4.0:
                error = np.array((off[side], line.rho - DISTANCES[side]))
                found.append(error @ np.linalg.solve(line.covariance, error) / 2.0)
    assert len(found) > 3 * ROOMS
    return float(np.mean(found))


def test_exact_walls_keep_the_covariance_of_their_noise():
    low, high = mean_nees_band(8 * ROOMS, 1, level=0.998)
    assert low < mean_chi2(0.0, SIGMA_M) < high
    rng = np.random.default_rng(8)
    for _ in range(20):  # at 0.001 a test, no room of twenty has more than what is stated
        ranges = room(0.0, SIGMA_M, rng)
        stated = extract_lines(ranges, ANGLES, sigma=SIGMA_M, shared_error=False)
        for line, other in zip(extract_lines(ranges, ANGLES, sigma=SIGMA_M), stated, strict=True):
            assert line.covariance == pytest.approx(other.covariance, rel=1e-9)
            assert (line.alpha, line.rho) == (other.alpha, other.rho)


def test_noise_that_is_understated_shows():
    low, high = mean_nees_band(8 * ROOMS, 1, level=0.998)
    assert low < mean_chi2(0.0, 1.4 * SIGMA_M) < high
    assert mean_chi2(0.0, 1.4 * SIGMA_M, shared_error=False) > 1.7


def test_walls_that_wander_are_known_as_well_as_is_said():
    """Not parted, for pieces that pass for straight hide what they share; by the stated noise some 35."""
    whole = LineConfig(significance=1e-100, max_misfit=1e6)
    assert mean_chi2(0.002, SIGMA_M, config=whole) < 3.0
    assert mean_chi2(0.002, SIGMA_M, config=whole, shared_error=False) > 20.0


def test_what_is_stated_of_walls_is_a_lower_bound():
    ranges = room(0.0, SIGMA_M, np.random.default_rng(3))
    config = LineConfig(flatness=0.004)
    stated = extract_lines(ranges, ANGLES, sigma=SIGMA_M, config=config, shared_error=False)
    for line, other in zip(extract_lines(ranges, ANGLES, sigma=SIGMA_M, config=config), stated, strict=True):
        assert line.covariance == pytest.approx(other.covariance, rel=1e-9)
