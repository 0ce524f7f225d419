"""Rounded coordinates: the step is found, planes are no surer than it lets them be, and all others stay as they are."""

import numpy as np
import pytest

from spplanes import fit_plane, segment_cloud
from spplanes.fitting.rounding import coordinate_steps, with_rounding
from tests.statistics import assert_mean_in_band

STEP_M = 0.01
NORMAL, UTM = np.random.default_rng(0).normal(size=(9_000, 3)), np.array([5e5, 4.5e6, 0.1])


def turn(degrees: float) -> np.ndarray:
    """About y, and then by as much about x."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]) @ np.array(
        [[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]
    )


def rounded_wall(rng: np.random.Generator, noise_m: float, degrees: float) -> tuple[np.ndarray, np.ndarray, float]:
    """3000 points of a wall of 4 x 2 m, rounded, shape (3000, 3), its normal and its distance."""
    flat = np.column_stack(
        (rng.uniform(-2.0, 2.0, 3000), rng.uniform(-1.0, 1.0, 3000), noise_m * rng.normal(size=3000))
    )
    rotation, centre = turn(degrees), np.array([0.0, 0.0, 1.0 + rng.uniform(0.0, STEP_M)])
    points = np.round((flat @ rotation.T + centre) / STEP_M) * STEP_M
    return points, rotation[:, 2], float(rotation[:, 2] @ centre)


def chi2_of_offsets(noise_m: float, degrees: float, runs: int = 80) -> np.ndarray:
    """Squared errors of the offset over what is claimed of it, shape (runs,)."""
    rng, values = np.random.default_rng(7), []
    for _ in range(runs):
        points, normal, distance = rounded_wall(rng, noise_m, degrees)
        plane = fit_plane(points, sigma=noise_m, viewpoint=(0.0, 0.0, 9.0))
        off = (distance - normal @ plane.centre) / (normal @ plane.normal)
        values.append(off**2 / plane.covariance[0, 0])
    return np.array(values)


@pytest.mark.parametrize(("noise_m", "least"), [(0.0005, 0.3), (0.001, 0.3), (0.002, 0.3), (0.003, 0.05)])
def test_walls_across_an_axis_are_no_surer_than_the_rounding_lets_them_be(noise_m, least):
    """By the scatter alone the mean chi2 is beyond 1000."""
    assert least < chi2_of_offsets(noise_m, 0.0).mean() < 1.3


def test_more_noise_than_half_a_step_averages_the_rounding_out():
    assert_mean_in_band(chi2_of_offsets(0.005, 0.0), 1, 0.999)


@pytest.mark.parametrize("noise_m", [0.0005, 0.001, 0.002, 0.003, 0.005])
def test_of_skewed_walls_the_rounding_averages_out(noise_m):
    assert_mean_in_band(chi2_of_offsets(noise_m, 10.0), 1, 0.999)


def test_a_wall_of_one_rounded_value_claims_no_more_than_that_and_the_cloud_says_so():
    points = np.round(np.random.default_rng(0).normal([0.0, 0.0, 1.003], [1.0, 1.0, 0.001], (20_000, 3)), 2)
    found = segment_cloud(points)
    assert np.sqrt(found.planes[0].covariance[0, 0]) == pytest.approx(STEP_M / 12**0.5, rel=0.05)
    assert any("coordinates come in steps of 0.01 m" in one for one in found.warnings)


def test_points_without_noise_claim_some():
    rng = np.random.default_rng(1)
    exact = np.column_stack((rng.uniform(-5.0, 5.0, (2_000, 2)), np.zeros(2_000)))
    assert segment_cloud(exact).noise.sigma_m > 0.99e-6


@pytest.mark.parametrize(
    ("points", "steps"),
    [
        (np.round(NORMAL, 2), [0.01] * 3),
        (np.round(NORMAL, 2).astype(np.float32), [0.01] * 3),
        (np.round(NORMAL, 3) + UTM, [0.001] * 3),
        (NORMAL, [0.0] * 3),
        ((NORMAL + UTM).astype(np.float32), [1.0 / 32.0, 0.5, 0.0]),
        (np.round(NORMAL, 2) * [1.0, 1.0, 0.0] + UTM, [0.01] * 3),
        (NORMAL * [1.0, 1.0, 0.0], [0.0] * 3),
        (np.ones((50, 3)), [0.0] * 3),
        (np.full((50, 3), np.nan), [0.0] * 3),
        (np.empty((0, 3)), [0.0] * 3),
    ],
    ids=[
        "cm",
        "float32 cm",
        "UTM mm",
        "continuous",
        "float32 UTM",
        "cm, one height",
        "one height",
        "one",
        "NaN",
        "none",
    ],
)
def test_the_step_of_coordinates(points, steps):
    np.testing.assert_allclose(coordinate_steps(np.asarray(points, dtype=np.float64)), steps, rtol=1e-6)


def test_a_mesh_of_one_height_is_not_rounded_to_its_cells():
    x, y = np.meshgrid(np.arange(20.0), np.arange(20.0))
    plane = fit_plane(np.stack((x, y, np.zeros_like(x)), axis=-1).reshape(-1, 3), sigma=0.01)
    assert np.sqrt(plane.covariance[0, 0]) == pytest.approx(0.01 / 20.0)


def test_covariances_of_points_that_are_not_rounded_are_left_alone():
    points = np.random.default_rng(2).normal(size=(3000, 3)) * [2.0, 1.0, 0.005]
    covariances = 1e-8 * np.eye(3)[None]
    for given in (points, np.round(points, 4)):
        assert with_rounding(covariances, covariances, given, np.eye(4)[None], np.array([2.5e-5])) is covariances
